"""How a quantity of a scene, such as its peak stress, follows the material parameter."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def rank_correlation(parameter: Float[np.ndarray, "value"], response: Float[np.ndarray, "scene value"]) -> float:
    """Return Spearman's rank correlation of a response with the parameter, mean over scenes.

    1 means that the response rises with the parameter in every scene, -1 that it falls in every scene. A scene counts as 0 if the response does not change, or
    if one of its values is infinite or NaN because a rollout failed.

    Args:
        parameter: at least two different values of the material parameter.
        response: values of the quantity in scenes that differ in the parameter only.

    Raises:
        ValueError: the parameter does not change.
    """
    from scipy.stats import rankdata

    if len(np.unique(parameter)) < 2:
        raise ValueError(f"a rank correlation needs different values of the parameter, got {parameter.tolist()}")
    good = np.isfinite(response).all(axis=1)
    ranks = rankdata(np.where(good[:, None], response, 0.0), axis=1)
    own, ranks = rankdata(parameter) - (len(parameter) + 1) / 2, ranks - (len(parameter) + 1) / 2
    norm = np.sqrt((own**2).sum() * (ranks**2).sum(axis=1))
    return float(np.divide(ranks @ own, norm, out=np.zeros(len(response)), where=norm > 0).mean())

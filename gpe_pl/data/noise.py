"""Training noise: new position windows, consistent in velocity and position; the stored data is never touched.

A window holds positions x[t−H … t+1] [history + 2, node, dim]. Both kinds are additive on positions, so velocities and the target acceleration follow from
the noisy window by the integrator's own formulas.

- ``paper``: the same offset on every position, the target's included (paper, section 3.2): velocities and target stay as they are.
- ``velocity``: a random walk over the H velocities, integrated to positions; the next velocity stays the true one, so the target corrects the velocity
  noise exactly and the position noise not at all [Sanchez-Gonzalez et al. 2020, as in their published code].
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

NoiseKind = Literal["paper", "velocity"]


@dataclass(frozen=True)
class Noise:
    """Gaussian noise on the inputs of dynamic nodes.

    Attributes:
        kind: see the module's text.
        std: for ``paper`` in m; for ``velocity`` in units of the data's acceleration std × frame interval, that is of one frame's velocity change.
        correction: of ``velocity``, the share of the last position's noise that the target takes back within the step; a model that is to bring nodes back to
            where they belong needs some [γ of Pfaff et al. 2021, appendix A.2.2].
    """

    kind: NoiseKind = "velocity"
    std: Annotated[float, Field(ge=0, le=100)] = 0.3
    correction: Annotated[float, Field(ge=0, le=1)] = 0.0

    def apply(
        self, window: Float64[np.ndarray, "window node dim"], velocity_unit: float, frame_dt: float, rng: np.random.Generator
    ) -> Float64[np.ndarray, "window node dim"]:
        """A noisy copy of a position window.

        Args:
            window: x[t−H … t+1] in m.
            velocity_unit: acceleration std × frame interval [m/s].
            frame_dt: frame interval [s].
            rng: source of randomness.
        """
        if self.std == 0:
            return window
        if self.kind == "paper":
            return window + rng.normal(scale=self.std, size=window.shape[1:])
        history = window.shape[0] - 2
        steps = rng.normal(scale=self.std * velocity_unit / np.sqrt(history), size=(history, *window.shape[1:]))
        offset = np.zeros_like(window)
        offset[1:-1] = np.cumsum(np.cumsum(steps, axis=0) * frame_dt, axis=0)
        offset[-1] = (1 - self.correction) * offset[-2]
        return window + offset

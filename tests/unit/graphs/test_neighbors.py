"""Pairs that would fill the memory are refused before they are listed."""

from __future__ import annotations

import numpy as np
import pytest

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity
from gpe_pl.graphs import neighbors
from gpe_pl.graphs.neighbors import radius_between, radius_pairs
from gpe_pl.rollout.loop import SimulationError


@pytest.mark.parametrize("periodicity", [NOWHERE, Periodicity(((0.0, 1.0), (0.0, 1.0)), (True, False))])
def test_a_radius_in_another_unit_is_refused(monkeypatch: pytest.MonkeyPatch, periodicity: Periodicity) -> None:
    monkeypatch.setattr(neighbors, "MOST_PAIRS", 2**14)
    pos = np.random.default_rng(0).random((400, 2))
    for search in (
        lambda radius: radius_pairs(pos, radius, periodicity),
        lambda radius: radius_between(pos, pos.copy(), radius, periodicity),
    ):
        with pytest.raises(SimulationError, match=r"nodes within the radius of 0\.45 m of each of 400 nodes are too many") as refused:
            search(0.45)
        assert refused.value.reason == "clustering"
        assert search(0.1).shape[1] > 400

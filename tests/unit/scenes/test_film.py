"""Films tell how far apart their rollouts are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.scenes.film import Film
from gpe_pl.trajectory.boundary import Boundary
from tests.conftest import make_trajectory


def test_distances_are_those_of_the_nearest_images() -> None:
    walled = replace(make_trajectory(num_frames=4), boundary=Boundary.empty(2))
    periodic = replace(walled, metadata=replace(walled.metadata, periodic=(True, False)))
    for first, expected in ((walled, 0.9), (periodic, 0.1)):
        low, high = (replace(first, pos=np.full_like(first.pos, 0.5) + np.array([x, 0.0], np.float32)) for x in (-0.45, 0.45))
        film = Film("nodes beside both ends of an axis", low, {"model": high})
        assert film.distance("model") == pytest.approx(expected)
        assert f"{expected:.3g} m (root mean square)" in film.summary()

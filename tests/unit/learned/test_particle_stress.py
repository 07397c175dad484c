"""Sleeping keeps the stress of particles, which have no cells."""

from __future__ import annotations

from dataclasses import replace

import torch

from gpe_pl.learned.approximate import _combined_stress
from gpe_pl.learned.testing import scenes
from gpe_pl.trajectory.state import Stress


def test_particles_that_sleep_keep_their_stress() -> None:
    state = scenes.state(10).to_torch()
    before, after = (Stress(torch.full((10, 4), value), torch.zeros(0, 4)) for value in (1.0, 2.0))
    awake = torch.arange(10) < 4
    found = _combined_stress(replace(state, stress=before), replace(state, stress=after), awake, awake)
    assert found is not None
    assert found.node[:, 0].tolist() == [2.0] * 4 + [1.0] * 6
    assert found.cell.shape == (0, 4)

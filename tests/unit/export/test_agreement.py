"""What an exported step may differ by."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gpe_pl.export.agreement import STRESS_TOLERANCE, TOLERANCE, excess, largest_difference, tolerance
from gpe_pl.learned.testing import scenes


def test_positions_far_from_the_origin_may_differ_by_their_rounding() -> None:
    state = scenes.state().to_torch()
    assert tolerance([state]) == TOLERANCE
    assert tolerance([state, replace(state, pos=state.pos + 100.0)]) == pytest.approx(4 * 2**-23 * 100, rel=0.1)


def test_a_value_that_is_not_a_number_is_found_in_any_pair() -> None:
    good, bad = torch.tensor([1.0, 2.0]), torch.tensor([1.0, torch.nan])
    assert largest_difference([(good, good + 0.5), (good, good)]) == 0.5
    assert largest_difference([(good[:0], good[:0])]) == 0.0
    for pairs in ([(good, bad), (good, good)], [(good, good), (bad, good)]):
        found = largest_difference(pairs)
        assert found != found


def test_positions_and_stresses_have_limits() -> None:
    states, unit = [scenes.state().to_torch()], torch.tensor(2e4)
    allowed = STRESS_TOLERANCE * 2e4
    assert excess(0.9 * TOLERANCE, 0.9 * allowed, states, unit) is None
    assert excess(1e-5, 0.0, states, unit) == "by 1e-05 m, at most 1e-06 m are allowed"
    assert excess(0.0, 21.0, states, unit) == "by 21 Pa, at most 20 Pa are allowed"
    assert excess(float("nan"), 0.0, states, unit) == "by nan m, at most 1e-06 m are allowed"
    assert excess(0.0, float("nan"), states, unit) == "by nan Pa, at most 20 Pa are allowed"

"""A trajectory that cannot be simulated is refused, with the reason."""

from __future__ import annotations

import pytest

from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import GenerationError, generate_trajectory

SPEC = dataset("data=sand", "size=tiny")


@pytest.mark.parametrize(
    ("split", "index", "message"),
    [
        ("exam", 0, "split='exam': no such split; the splits are train, val, test, test_unseen"),
        ("test", -1, "index=-1: must be a number of a trajectory, from 0 on"),
    ],
)
def test_a_trajectory_has_a_split_and_a_number(split: str, index: int, message: str) -> None:
    with pytest.raises(GenerationError, match=message):
        generate_trajectory(SPEC, split, index)


def test_no_advice_for_the_solver_is_given_against_a_refused_parameter() -> None:
    with pytest.raises(GenerationError, match=r"friction_angle of sand is 95 deg, outside 0 … 60, the limits of the solvers$"):
        generate_trajectory(SPEC, "test", 0, values={"sand": 95.0}, num_frames=3)

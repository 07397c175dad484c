"""A trajectory that cannot be simulated is refused, with the reason; one with other parameters is labelled by them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gpe_pl.config.datasets import dataset
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data.ground_truth import GenerationError, ParameterValues, ValueGroups, generate_trajectory, group_of, parameter_values

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


@pytest.mark.parametrize("split", ["test", "test_unseen"])
@pytest.mark.parametrize(
    ("angle", "group"), [(20.0, "seen"), (20.000001, "seen"), (21.0, "interpolated"), (19.0, "extrapolated"), (50.0, "extrapolated")]
)
def test_a_trajectory_has_the_group_of_the_values_that_it_was_given(split: str, angle: float, group: str) -> None:
    spec = replace(SPEC, parameters={"sand": ParameterValues((20.0, 30.0, 40.0), (25.0,), (15.0,))})
    metadata = generate_trajectory(spec, split, 0, values={"sand": angle}, num_frames=3).metadata
    assert (metadata.split, metadata.parameter_group) == (split, group)


def test_the_density_of_a_scene_is_that_of_the_solver() -> None:
    """The solver takes the volume of a particle from its mass at its own density."""
    with pytest.raises(ConfigError, match=r"scene.density.elastomer = 4000.0 and solver.elastomer.density = 1000.0 must be equal"):
        dataset("data=elastomer", "size=tiny", "data.scene.density.elastomer=4000")
    both = dataset("data=elastomer", "size=tiny", "data.scene.density.elastomer=4000", "data.solver.elastomer.density=4000")
    assert both.scene.density["elastomer"] == 4000  # type: ignore[attr-defined]


def test_the_order_in_which_materials_are_named_changes_nothing() -> None:
    spec = dataset("data=mixed", "size=tiny")
    turned = replace(spec, parameters=dict(reversed(spec.parameters.items())))
    for index in range(4):
        assert parameter_values(turned, "train", index) == parameter_values(spec, "train", index)


def test_the_group_of_several_parameters_is_that_of_the_one_farthest_from_training() -> None:
    further = {"cohesion": ValueGroups((0.0, 500.0))}
    spec = replace(SPEC, parameters={"sand": ParameterValues((20.0, 40.0), (25.0,), (15.0,), further=further)})
    expected = {
        (20.0, 0.0): "seen",
        (20.0, 250.0): "interpolated",
        (30.0, 500.0): "interpolated",
        (30.0, 501.0): "extrapolated",
        (15.0, 0.0): "extrapolated",
    }
    for (angle, cohesion), group in expected.items():
        assert group_of(spec, {"sand": {"friction_angle": angle, "cohesion": cohesion}}) == group

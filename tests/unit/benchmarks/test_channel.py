"""Suite ``channel``: what it measures of a rollout, and its tables."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.benchmarks import channel
from gpe_pl.benchmarks.channel import CONTROL, SOLVER, ChannelError, Settings, errors, figures, measured, report
from gpe_pl.benchmarks.trained import Case, SameNameError
from gpe_pl.config.datasets import dataset
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory

DT, BOUNDS = 0.05, ((0.0, 1.0), (0.0, 1.0))
INLET = Opening((0.0, 0.0), (0.2, 0.3), "x_low", 1.0, 0.1, node_code("fluid"), 2.0, (0.01,))


@pytest.fixture
def flow() -> Trajectory:
    """Return a flow of 1 m/s, 0.3 m deep, that is steady after a second."""
    pos = INLET.nodes_at_start()
    count = len(pos)
    state = State(
        pos, np.tile(INLET.velocity_at(0.0), (count, 1)), np.full(count, INLET.node_type, np.uint8), np.full(count, 2.0),
        np.full((count, 1), 0.01), Boundary.sample(domain_walls(BOUNDS, 0.0), 0.1, 2), np.zeros(2), param_names=("kinematic_viscosity",),
    )  # fmt: skip
    metadata = Metadata("channel", ("fluid",), ("kinematic_viscosity",), DT, 0.1, 0.2, BOUNDS, (0.0, 0.0), split="test")
    return rollout(ConstantVelocity(DT), state.opened([INLET, Opening((0.8, -0.1), (1.0, 1.0), "x_high")]), 80, metadata)


def test_a_steady_flow_is_measured_as_such(flow: Trajectory) -> None:
    values = measured(flow, 80)
    assert values["enters"] == values["leaves"] == pytest.approx(2.0 * 3 / 0.1)
    assert values["level"] == pytest.approx(0.3, rel=0.03)
    assert values["drift"] == pytest.approx(0.0, abs=0.06)
    assert (values["frames"], values["unaccounted"]) == (80, 0)
    assert len(values["time"]) == len(values["curve"]) == 81


def test_a_rollout_that_stopped_has_no_means(flow: Trajectory) -> None:
    values = measured(replace(flow.frames(0, 9), termination=Termination("nan", 9, 0, "")), 80)
    assert values["level"] is None
    assert values["frames"] == 8
    assert errors(values, measured(flow, 80)) == (math.inf, math.inf)


def test_tables_have_errors_relative_to_the_solver(flow: Trajectory) -> None:
    about = {
        "case": "channel",
        "split": "test",
        "scene": 0,
        "viscosity": 0.01,
        "group": "seen",
        "speed": 1.0,
        "inlet_height": 0.3,
        "has_sill": False,
    }
    true = measured(flow, 80)
    wrong = {**true, "leaves": 0.97 * true["leaves"], "level": 1.2 * true["level"]}
    stopped = measured(replace(flow.frames(0, 9), termination=Termination("nan", 9, 0, "")), 80)
    rollouts = ((SOLVER, true), ("good", true), ("deep", wrong), ("stopped", stopped))
    records = [{**about, "simulator": name, **own} for name, own in rollouts]
    table = report(records)
    assert "| deep | 80 | 60 | 58.2 | -3.0 % | 0.351 | +20.0 % |" in table
    assert "| good | 1 | 1 of 1 | 0.0 % | 0.0 % | 0.0 % | 0.0 % |" in table
    assert "| deep | 1 | 0 of 1 | 3.0 % | 3.0 % | 20.0 % | 20.0 % |" in table
    assert "| stopped | 1 | 0 of 1 | – | – | – | – | – |" in table
    assert figures(records).keys() == {"channel"}


def test_data_without_inlet_are_refused() -> None:
    spec = dataset("data=fluid", "size=tiny")
    with pytest.raises(ChannelError, match="fluid, test 0: has no inlet; choose a data set of open channels, such as data=channel"):
        list(channel.channel_records(CONTROL, None, spec, [("test", 0)], 0.1))


def test_models_of_one_name_are_refused(tmp_path: Path) -> None:
    spec = dataset("data=channel", "size=tiny", "dimension=2")
    settings = Settings([str(tmp_path / "old" / "sand"), str(tmp_path / "new" / "sand")], {"channel": Case([])}, {"test": 1}, 0.1)
    with pytest.raises(SameNameError, match="two checkpoints are called sand; copy one of them to a file of another name"):
        channel.run(settings, {"channel": spec}, tmp_path)


@pytest.mark.slow
def test_a_suite_goes_on_after_an_error(tmp_path: Path) -> None:
    spec = dataset("data=channel", "size=tiny", "dimension=2", "data.scene.changing=0.0")
    settings = Settings(["missing.ckpt"], {"channel": Case([])}, {"test": 1}, 0.1)
    with pytest.raises(Exception, match=r"missing\.ckpt"):
        channel.run(settings, {"channel": spec}, tmp_path)
    assert len([*(tmp_path / "parts").glob("*.json")]) == 2
    records, table = channel.run(replace(settings, checkpoints=[]), {"channel": spec}, tmp_path)
    assert [record["simulator"] for record in records] == [SOLVER, CONTROL]
    assert all(record["unaccounted"] == 0 for record in records)
    assert "test 0 (seen)" in table

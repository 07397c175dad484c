"""A scene in other units of length and time is trained, validated and evaluated as in metres and seconds."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger

from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.dataset import collated
from gpe_pl.data.importers import ImportFailure, save_dataset
from gpe_pl.data.importers.source import SMALLEST, number
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.evaluation import rollouts
from gpe_pl.evaluation.metric_rows import Row
from gpe_pl.evaluation.predictions import start_of
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.geometry.shapes import Box, Shape, Sphere, domain_walls
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import UNITS, bodies, open_scenes
from gpe_pl.models.base import Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.run import TrainerSettings, TrainingSettings, train
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.trajectory import Trajectory
from tests import scenes

NUM_FRAMES, FRAME_DT, SPACING = 16, 0.01, 0.1
STEPS, INTERVAL = 6, 2
UNIT_OF = {**UNITS, "skipping_mse": "m^2"}
"""Units of metrics; those without an entry have no unit."""


def scene(seed: int, length: float, time: float, dim: int = 2, mesh: bool = False) -> Trajectory:
    """Two blocks that fall past obstacles onto a floor, of sand and liquid or with a mesh; every length times ``length`` and every time times ``time``."""
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(*[np.arange(4 if dim == 2 else 3)] * dim), -1).reshape(-1, dim)
    block = SPACING * (lattice + 0.1 * rng.uniform(-1, 1, lattice.shape))
    t = FRAME_DT * np.arange(NUM_FRAMES)[:, None, None]
    gravity = np.eye(dim)[-1] * -9.81
    blocks = []
    for corner in (0.05, 0.55):
        shake = 1 + 0.1 * np.sin(rng.uniform(20, 40) * t + rng.uniform(0, 6))
        blocks.append(np.append(np.full(dim - 1, corner), 0.2) + block * shake + rng.uniform(-1, 1, dim) * t + 0.5 * gravity * t**2)
    pos = np.clip(np.concatenate(blocks, axis=1), 1e-3, 1 - 1e-3)
    bounds = tuple((0.0, length) for _ in range(dim))
    middle = tuple(0.5 * length for _ in range(dim))
    box = Box(tuple(0.8 * length for _ in range(dim)), tuple(0.9 * length for _ in range(dim)), 0.2)
    shapes: tuple[Shape, ...] = (*domain_walls(bounds, 0.5), Sphere(middle, 0.1 * length, 0.3), box)
    cells = None
    if mesh:
        corners = np.arange(16).reshape(4, 4)
        lower, upper = (corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:]), (corners[1:, 1:], corners[:-1, 1:], corners[1:, :-1])
        cells = np.concatenate([np.stack(part, -1).reshape(-1, 3) for part in (lower, upper)])
        cells = np.concatenate([cells, 16 + cells])
    names = ["elastomer"] * 2 * len(block) if mesh else ["sand"] * len(block) + ["fluid"] * len(block)
    params = {"elastomer": 2.0**15 / length / time**2} if mesh else {"sand": 30.0 + seed, "fluid": 0.01 * (1 + seed) * length**2 / time}
    return Trajectory.from_numpy(
        (pos * length).astype(np.float32), FRAME_DT * time, names, params, cells=cells,
        gravity=gravity * length / time**2, bounds=bounds, boundary=Boundary.sample(shapes, SPACING * length, dim),
        spacing=SPACING * length, connectivity_radius=1.5 * SPACING * length, mass=2.0**-3 * np.ones(len(names)),
    )  # fmt: skip


def model(name: str, spec: Any) -> Model:
    if name == "GNS":
        return GNS(spec, num_message_passing_steps=2, hidden_channels=8)
    if name == "DPINet":
        return DPINet(spec, hidden_channels=8)
    if name == "ContinuousConvNet":
        return ContinuousConvNet(spec)
    return GPE(spec, num_message_passing_steps=2, hidden_channels=8)


class Recorded(TrainingModule):
    """Callback that records the losses of training."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.losses: list[float] = []

    def training_step(self, batch: Any, batch_idx: int) -> torch.Tensor | None:
        loss = super().training_step(batch, batch_idx)
        assert loss is not None
        self.losses.append(float(loss.detach()))
        return loss


@cache
def stored(root: Path, length: float, time: float, dim: int, mesh: bool) -> str:
    """Make two scenes for training, two for tests and one for validation."""
    folder = root / f"{length}_{time}_{dim}_{mesh}"
    train, val, test = ([scene(seed, length, time, dim, mesh) for seed in seeds] for seeds in ((0, 1), (2,), (4, 5)))
    return save_dataset(folder, "scaled", train=train, val=val, test=test).folder


def data(root: Path, length: float, time: float, dim: int = 2, mesh: bool = False) -> TrajectoryDataModule:
    """Open the data set with these units, which is made once."""
    config, noise = GraphConfig(history=2, islands=True, mesh=mesh), Noise(velocity_of_change=0.3, correction=0.5)
    return TrajectoryDataModule(stored(root, length, time, dim, mesh), config, noise, BatchSize(2), seed=1, sampling="activity")


def new_module(data: TrajectoryDataModule, name: str) -> Recorded:
    torch.manual_seed(3)
    simulator = LearnedSimulator(model(name, data.builder.spec), data.builder)
    simulator.fit_statistics(data.statistics_sample(), data.parameter_ranges())
    return Recorded(simulator, STEPS, learning_rate=1e-2, warmup_steps=2, compile="off")


def trained(folder: Path, root: Path, length: float, time: float) -> tuple[list[float], int, list[Row]]:
    """Return losses of a short training, the step of its best checkpoint, and the result of its evaluation."""
    datamodule = data(folder, length, time)
    module = new_module(datamodule, "GPE")
    settings = TrainingSettings(
        STEPS, batch_size=2, warmup_steps=2, push_fraction=0.5, push_steps=2, compile="off", val_interval=INTERVAL, num_val_rollouts=1,
        val_rollout_steps=6,
    )  # fmt: skip
    best = train(module, datamodule, settings, TrainerSettings(progress=False), [CSVLogger(root, name="log")], root)
    step = torch.load(best, weights_only=True)["global_step"]
    evaluation = EvaluationSettings(["test"], [3 * FRAME_DT * time, 8 * FRAME_DT * time], num_pictures=0)
    rows = rollouts.evaluate(LearnedSimulator.from_checkpoint(best), datamodule.root, evaluation, root)
    return module.losses, step, rows


@cache
def in_metres(folder: Path) -> tuple[list[float], int, list[Row]]:
    return trained(folder, folder / "run", 1.0, 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the data sets in all units."""
    return tmp_path_factory.mktemp("scaled")


def in_units(metric: str, length: float, time: float) -> float:
    """Return the factor that converts a metric to other units."""
    powers = {name: int(power or 1) for name, power in re.findall(r"(?<!/)\b([ms])(?:\^(\d))?", UNIT_OF.get(metric, "1").split("/")[0])}
    below = 1 if "/s" in UNIT_OF.get(metric, "1") else 0
    return length ** powers.get("m", 0) / time**below


POWERS = [(20, -12), (-20, 0), (0, 12), (-7, -12), (13, 5)]


@pytest.mark.slow
@pytest.mark.parametrize(("length", "time"), [*POWERS[:2], *(pytest.param(*power, marks=pytest.mark.long) for power in POWERS[2:])])
def test_powers_of_two_change_nothing_but_the_units(length: int, time: int, tmp_path: Path, folder: Path) -> None:
    losses, step, rows = in_metres(folder)
    own_losses, own_step, own_rows = trained(folder, tmp_path, 2.0**length, 2.0**time)
    assert own_losses == losses
    assert own_step == step > INTERVAL
    assert {r.metric for r in rows} >= {"fraction_corrected", "fraction_outside_uncontained", "fraction_outside_at_end", *UNIT_OF} - {
        "skipping_mse", "von_mises_error", "stress_error", "mirror_error", *bodies.UNITS, "rigid_deformation", *open_scenes.UNITS,
    }  # fmt: skip
    assert max(r.value for r in rows if r.metric == "fraction_corrected") > 0
    horizons, own_horizons = ([*dict.fromkeys(r.horizon for r in found)] for found in (rows, own_rows))  # in seconds
    assert len(horizons) == 4
    for row, own in zip(rows, own_rows, strict=True):
        assert (own.model, own.metric, own.trajectory) == (row.model, row.metric, row.trajectory)
        assert own_horizons.index(own.horizon) == horizons.index(row.horizon)
        assert own.value == row.value * in_units(row.metric, 2.0**length, 2.0**time) or math.isnan(row.value)


def losses(data: TrajectoryDataModule, name: str, num_steps: int) -> list[float]:
    """Return the losses of the first steps of training."""
    module = new_module(data, name)
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-3)
    found = []
    for batch, _ in zip(data.batch_size.batches(data.train_set, 0, 0), range(num_steps), strict=False):
        loss = module.loss(collated([data.train_set[key] for key in batch]))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        found.append(float(loss.detach()))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dim", "mesh"), [("GNS", 2, False), ("ContinuousConvNet", 2, False), ("GPE", 3, False), ("GPE", 2, True), ("DPINet", 2, True)]
)
def test_every_model_and_meshes_train_the_same(name: str, dim: int, mesh: bool, folder: Path) -> None:
    expected = losses(data(folder, 1.0, 1.0, dim, mesh), name, 3)
    assert losses(data(folder, 2.0**20, 2.0**-12, dim, mesh), name, 3) == expected
    assert len(set(expected)) == 3


DECIMAL = [(1e-6, 1e4), (1e-3, 1.0), (1e6, 1e-4), (1e-6, 1e-4), (1e6, 1e4)]


@pytest.mark.slow
@pytest.mark.parametrize(("length", "time"), DECIMAL)
def test_decimal_units_change_the_first_losses_by_rounding_only(length: float, time: float, folder: Path) -> None:
    expected = losses(data(folder, 1.0, 1.0), "GPE", 10)
    np.testing.assert_allclose(losses(data(folder, length, time), "GPE", 10), expected, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("still", [False, True])
def test_limits_of_evaluated_rollouts_follow_the_scene(still: bool, folder: Path) -> None:
    guards = []
    for length, time in ((1.0, 1.0), (2.0**20, 2.0**-12)):
        datamodule = data(folder, length, time)
        (trajectory,) = datamodule.val_trajectories(1)
        if still:
            trajectory = replace(trajectory, pos=np.repeat(trajectory.pos[:1], NUM_FRAMES, axis=0), vel=np.zeros_like(trajectory.vel))
        simulator = new_module(datamodule, "GPE").simulator
        guard = start_of(simulator, 2, trajectory, trajectory.frames(2)).guard
        assert guard is not None
        guards.append(guard)
    usual, scaled = guards
    assert scaled.max_speed == usual.max_speed * 2.0**32 and scaled.margin == usual.margin * 2.0**20
    assert 1 < usual.max_speed < math.inf


@pytest.mark.parametrize("pressure", [1e-3, 1e6])
def test_small_stresses_are_learned_in_their_own_scale(pressure: float) -> None:
    """An error of 1 Pa is large if stresses are about 1 mPa, so the loss cannot be in Pa."""
    graph = scenes.graph(("solid",))
    nodes = graph["solid"]
    nodes.target = torch.ones(nodes.num_nodes, 2)
    nodes.stress_target = torch.full((nodes.num_nodes, 4), pressure)
    build = scenes.builder(("solid",))
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build)
    simulator.fit_statistics([graph])
    assert float(simulator.stress_std) == pytest.approx(pressure)


@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3])
def test_bounds_of_a_row_of_nodes_are_as_wide_as_it_is_long(length: float) -> None:
    row = np.stack([np.linspace(0, length, 5), np.zeros(5)], axis=-1)
    trajectory = Trajectory.from_numpy(np.repeat(row[None], 3, axis=0), 0.01, "sand", {"sand": 30.0})
    np.testing.assert_allclose(np.ptp(trajectory.metadata.bounds, axis=1), length)


def test_a_source_may_have_steps_of_femtoseconds(tmp_path: Path) -> None:
    values = {"dt": 1e-15, "none": 0.0}
    assert number(values, "dt", tmp_path, low=SMALLEST) == 1e-15
    with pytest.raises(ImportFailure, match=r"none = 0\.0, expected a number of at least"):
        number(values, "none", tmp_path, low=SMALLEST)

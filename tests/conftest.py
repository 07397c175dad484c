"""Small states and reference computations for several tests."""

from __future__ import annotations

import gc
import importlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from gpe_pl.geometry.shapes import Box, domain_walls
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.store import write_shard
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from tests import settings_files as settings_files

gc.disable()  # until the tests begin: modules and tests are never freed, and to look for cycles among them takes seconds

settings.register_profile("fast", max_examples=20, deadline=None, derandomize=True, database=None)
settings.register_profile("fuzz", max_examples=2000, deadline=None, print_blob=True)  # make fuzz
settings.load_profile("fast")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all-extras", action="store_true", help="a test that lacks a package fails, instead of being skipped")
    parser.addoption(
        "--physics-page", metavar="FILE", help="write every measured value of tests/physics to FILE (Markdown) and beside it as CSV"
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--all-extras"):
        pytest.importorskip = lambda name, *_, **__: importlib.import_module(name)  # type: ignore[assignment]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    result = yield
    gc.freeze()
    gc.set_threshold(20_000)  # graphs and configurations are many small objects, and few of them are in cycles
    gc.enable()
    return result


def make_trajectory(seed: int = 0, num_frames: int = 6, num_nodes: int = 12, **metadata: object) -> Trajectory:
    """Return a valid trajectory of sand in a unit box with walls and an obstacle; the motion is random, not physical."""
    rng = np.random.default_rng(seed)
    bounds = ((0.0, 1.0), (0.0, 1.0))
    values = {
        "dataset": "grains",
        "materials": ("sand",),
        "param_names": ("friction_angle",),
        "frame_dt": 0.01,
        "spacing": 0.1,
        "connectivity_radius": 0.15,
        "bounds": bounds,
        "gravity": (0.0, -9.81),
        "solver_dt": 1e-4,
        "seed": seed,
        "split": "train",
        "solver": "random",
        "solver_version": "1",
    }
    boundary = Boundary.sample((*domain_walls(bounds, 0.4), Box((0.4, 0.0), (0.6, 0.1), 0.2)), 0.1, 2)
    arrays = {name: getattr(boundary, name).astype(np.float32) for name in ("pos", "vel", "normal", "friction", "restitution")}
    return Trajectory(
        Metadata(**{**values, **metadata}),  # type: ignore[arg-type]
        rng.uniform(0.2, 0.8, (num_frames, num_nodes, 2)).astype(np.float32),
        rng.normal(size=(num_frames, num_nodes, 2)).astype(np.float32),
        np.full(num_nodes, node_code("sand"), np.uint8),
        np.full(num_nodes, 2.5, np.float32),
        np.full((num_nodes, 1), 30.0, np.float32),
        replace(boundary, **arrays),
    )


@pytest.fixture
def trajectory() -> Trajectory:
    return make_trajectory()


@pytest.fixture
def new_trajectory() -> Callable[..., Trajectory]:
    """Function that makes further trajectories: ``new_trajectory(seed, num_frames=…, split=…)``."""
    return make_trajectory


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Folder of a data set with two trajectories for training and one of each other split."""
    root = tmp_path / "grains"
    write_shard(root / "train" / "shard-00000.h5", [make_trajectory(seed) for seed in (0, 1)])
    for seed, split in enumerate(("val", "test", "test_unseen"), start=2):
        group = "extrapolated" if split == "test_unseen" else "seen"
        write_shard(root / split / "shard-00000.h5", [make_trajectory(seed, split=split, parameter_group=group)])
    return root


@pytest.fixture
def brute_force_radius() -> Callable[[np.ndarray, np.ndarray, float], set[tuple[int, int]]]:
    """Find by float64 distances all pairs (source, target) within the radius, as a reference for neighbour search."""

    def pairs(source: np.ndarray, target: np.ndarray, radius: float) -> set[tuple[int, int]]:
        offset = np.asarray(source, np.float64)[:, None] - np.asarray(target, np.float64)[None]
        return {(int(i), int(j)) for i, j in np.argwhere((offset**2).sum(-1) <= radius**2)}

    return pairs


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Use one thread: small tensors run faster, and results do not depend on the number of cores."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def step_times_of_few_steps() -> Iterator[None]:
    """Shorten the measurement of step times: tests of time budgets check that steps are measured and stored, not their precise time."""
    from gpe_pl.training import budget

    with pytest.MonkeyPatch.context() as monkeypatch:
        for name in ("WARM_UP_STEPS", "MEASURED_STEPS", "ROUNDS"):
            monkeypatch.setattr(budget, name, 1)
        yield


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory, step_times_of_few_steps: None) -> Path:
    """Generated data set for training runs of seconds (``tests.runs``), also within time budgets. It is shared, so never write to it."""
    from tests.runs import generate_tiny

    return generate_tiny(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two trajectories."""
    path = tmp_path_factory.mktemp("shard") / "shard-00000.h5"
    write_shard(path, [make_trajectory(seed) for seed in (0, 1)])
    return path


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint of a small GPE, in the shipped form."""
    import torch

    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.models.gpe import GPE
    from tests.scenes import builder

    torch.manual_seed(0)
    build = builder()
    path = tmp_path_factory.mktemp("checkpoint") / "sound.ckpt"
    LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=4), build).save(path)
    return path

"""``python -m gpe_pl.simulate`` as a user runs it: every data set, parts, sweeps and launchers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gpe_pl.data.validate import validate
from tests.runs import compose

ROOT = Path(__file__).parents[2]
FEW = [
    f"data.sizes.tiny.{key}={value}"
    for key, value in {
        "num_train": 4, "num_val": 1, "num_test": 1, "num_test_unseen": 2, "num_frames": 12, "trajectories_per_shard": 2,
    }.items()
]  # fmt: skip


def simulate(data: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gpe_pl.simulate", *arguments, f"paths.data={data}", "num_workers=1", *FEW]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def checked(folder: Path, num_trajectories: int) -> None:
    result = validate([folder])
    assert not result.violations
    assert sum(len(group.frames) for group in result.groups.values()) == num_trajectories
    assert (folder / "contact_sheet.png").is_file() and (folder / "statistics.json").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        pytest.param(["data=sand", "dimension=3"], "sand_3d", marks=pytest.mark.long),
        pytest.param(["data=snow", "dimension=3"], "snow_3d", marks=pytest.mark.long),
        pytest.param(["data=elastomer", "dimension=3"], "elastomer_3d", marks=pytest.mark.long),
        pytest.param(["data=mixed"], "mixed", marks=pytest.mark.long),
        pytest.param(["data=mixed", "dimension=3"], "mixed_3d", marks=pytest.mark.long),
        pytest.param(["data=snow_on_liquid"], "snow_on_liquid", marks=pytest.mark.long),
        pytest.param(["data=snow_on_liquid", "dimension=3"], "snow_on_liquid_3d", marks=pytest.mark.long),
        pytest.param(["data=fluid", "dimension=2"], "fluid_2d", marks=pytest.mark.long),
        pytest.param(["data=fluid", "scene=dam_break"], "fluid_dam_break", marks=pytest.mark.long),
        pytest.param(["data=fluid", "scene=dam_break", "dimension=2"], "fluid_dam_break_2d", marks=pytest.mark.long),
        pytest.param(["data=fluid", "scene=canyon"], "fluid_canyon", marks=pytest.mark.long),
        (["data=fem", "dimension=3"], "fem_3d"),
        pytest.param(["data=fem", "data.scene.cell=quad", "data.name=fem_quad"], "fem_quad", marks=pytest.mark.long),
    ],
)
def test_every_variant(tmp_path: Path, arguments: list[str], name: str) -> None:
    done = simulate(tmp_path, *arguments)
    assert done.returncode == 0, done.stderr
    checked(tmp_path / name / "tiny", 8)


@pytest.mark.slow
@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
@pytest.mark.parametrize("data", ["sand", "snow", "elastomer", "mixed", "snow_on_liquid", "fluid", "fem"])
def test_every_size_composes(data: str, size: str) -> None:
    from gpe_pl.config.datasets import dataset_spec

    spec = dataset_spec(compose("simulate", f"data={data}", f"size={size}"))
    assert (spec.name, spec.size) == (data, size)
    assert len(spec.scene.bounds) == (3 if data == "fluid" else 2)


@pytest.mark.long
def test_a_sweep_over_parts_and_data_sets(tmp_path: Path) -> None:
    done = simulate(tmp_path, "-m", "data=sand,fem", "num_parts=2", "part=0,1")
    assert done.returncode == 0, done.stderr
    for name in ("sand", "fem"):
        checked(tmp_path / name / "tiny", 8)


@pytest.mark.long
def test_a_sweep_on_ray(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    done = simulate(tmp_path, "-m", "data=sand,fem", "hydra/launcher=ray")
    assert done.returncode == 0, done.stderr
    for name in ("sand", "fem"):
        checked(tmp_path / name / "tiny", 8)

"""Shipped models are small, described, and found by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.learned.pretrained import FOLDER, checkpoint_path, model_name, names
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import headline

LIMIT = 2_000_000


def test_a_path_stays_a_path() -> None:
    assert checkpoint_path("runs/sand/best.ckpt") == Path("runs/sand/best.ckpt")
    assert checkpoint_path("no such model") == Path("no such model")


def test_a_run_is_named_by_its_folder(tmp_path: Path) -> None:
    assert checkpoint_path(tmp_path) == tmp_path / "checkpoints" / "best.ckpt"


def test_a_model_is_called_as_its_run(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "sweep" / "seed=0"
    assert model_name("sand", "runs") == "sand"
    assert model_name(run, tmp_path / "runs") == model_name(run / "checkpoints" / "best.ckpt", tmp_path / "runs") == "sweep_seed=0"
    assert model_name(run / "checkpoints" / "last.ckpt", tmp_path / "runs") == "sweep_seed=0_last"
    assert model_name(run / "checkpoints" / "best.ckpt", tmp_path / "other") == "seed=0"
    assert model_name(tmp_path / "water.ckpt", tmp_path / "runs") == "water"
    assert model_name(tmp_path / "c:d.ckpt", tmp_path) == "c~3Ad" and model_name(tmp_path / "a" / "c=*", tmp_path) == "a_c=~2A"


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_a_shipped_model_is_small_described_and_loads(name: str) -> None:
    path = checkpoint_path(name)
    assert path.parent == FOLDER
    assert path.stat().st_size <= LIMIT
    card = path.with_suffix(".md").read_text()
    simulator = LearnedSimulator.from_checkpoint(path)
    assert simulator.builder.metadata.dataset in card
    first = card.splitlines()[2]
    assert first.strip("*.").lower() == headline(name).lower()
    assert "python -m gpe_pl.fit" in card

"""A run's folder: whose it is, and whose model another run may take."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gpe_pl.training.run import RunError, adopt, claim

CONFIG: dict[str, Any] = {"seed": 0, "model": {"depth": 3}, "training": {"batch_size": 2}}
BY_NODES = {**CONFIG, "batching": {"max_nodes": 500}}


def finished(folder: Path, config: dict[str, Any]) -> Path:
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "best.ckpt").write_bytes(b"weights")
    (folder / "metrics.csv").touch()
    (folder / "config.json").write_text(json.dumps({**config, "evaluation": {"splits": ["test"]}}))
    return folder


@pytest.mark.parametrize(("there", "now"), [(CONFIG, BY_NODES), (BY_NODES, CONFIG), (BY_NODES, {**CONFIG, "batching": {"max_nodes": 400}})])
def test_batches_of_another_kind_make_another_run(tmp_path: Path, there: dict[str, Any], now: dict[str, Any]) -> None:
    folder = finished(tmp_path / "there", there)
    assert adopt(tmp_path / "there", now, tmp_path / "now") is None
    with pytest.raises(RunError, match=r"another configuration \(batching"):
        claim(folder, {**now, "evaluation": {"splits": ["test"]}})


@pytest.mark.parametrize("config", [CONFIG, BY_NODES])
def test_the_same_configuration_is_the_same_run(tmp_path: Path, config: dict[str, Any]) -> None:
    folder = finished(tmp_path / "there", config)
    claim(folder, {**config, "evaluation": {"splits": ["test"]}})
    taken = adopt(tmp_path / "there", config, tmp_path / "now")
    assert taken is not None and taken.read_bytes() == b"weights"

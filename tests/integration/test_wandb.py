"""W&B without a network: metrics, config, figures and animations are stored beside the run, under an identifier that a resumed run finds again."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from gpe_pl.fit import fit
from gpe_pl.training.tracking import has_key, run_id
from tests.runs import tiny


@pytest.fixture(autouse=True)
def _no_key(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("WANDB_SILENT", "true")


def test_a_key_is_found_where_wandb_looks_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not has_key()
    (tmp_path / "netrc").write_text("machine api.wandb.ai login user password secret\n")
    assert has_key()
    monkeypatch.setenv("WANDB_BASE_URL", "https://wandb.example.org")
    assert not has_key()
    (tmp_path / "netrc").write_text("machine wandb.example.org login user password secret and more")
    assert not has_key()  # damaged
    monkeypatch.setenv("WANDB_API_KEY", "secret")
    assert has_key()


def test_the_identifier_of_a_run_stays(tmp_path: Path) -> None:
    first = run_id(tmp_path / "a")
    assert run_id(tmp_path / "a") == first != run_id(tmp_path / "b")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["run_id"]


@pytest.mark.slow
def test_a_run_without_a_key_is_kept_offline_and_resumes(tiny_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    steps = ("training.num_steps=4", "training.val_interval=2", "training.warmup_steps=2")
    cfg = tiny(tiny_data, tmp_path, "logger=wandb", "name='group/model=a'", "evaluation.num_pictures=1", *steps)
    folder = tmp_path / "group" / "model=a"
    with caplog.at_level(logging.WARNING, "gpe_pl"):
        fit(cfg)
    number = (folder / "run_id").read_text()
    (kept,) = (folder / "wandb").glob(f"offline-run-*-{number}")
    notice = next(r.getMessage() for r in caplog.records if "wandb sync" in r.getMessage())
    assert notice == f"W&B: kept offline, as there is no API key; upload it with `wandb sync {kept}`"
    media = {p.suffix for p in (kept / "files" / "media").rglob("*") if p.is_file()}
    assert {".png", ".gif"} <= media
    record = (kept / f"run-{number}.wandb").read_bytes()
    for key in (b"learning_rate", b"val/rollout_mse", b"train/loss", b"test/rollout_mse@full", b"rollout_test_00", b"gpe_pl"):
        assert key in record, key
    (folder / "metrics.csv").unlink()  # as if it had been killed while evaluating
    fit(cfg)
    assert len([*(folder / "wandb").glob(f"offline-run-*-{number}")]) >= 1
    assert (folder / "run_id").read_text() == number

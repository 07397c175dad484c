"""The folder of results is small, and every table in it states its provenance."""

from __future__ import annotations

import json
import lzma
import runpy
import shutil
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from gpe_pl.files import sealed

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
MOST_KIBIBYTES = 6 * 1024
BLOCK = 4096
"""Files take whole blocks of a disk [bytes]."""


def tracked() -> list[Path]:
    names = subprocess.run(["git", "ls-files", "docs/results"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [ROOT / name for name in names]


def test_results_are_small() -> None:
    """As ``du -c`` counts."""
    blocks = sum(-(-path.stat().st_size // BLOCK) for path in tracked())
    assert 0 < blocks * BLOCK <= MOST_KIBIBYTES * 1024


def test_every_folder_says_where_it_comes_from() -> None:
    folders = {path.parent for path in tracked()} - {RESULTS}
    assert folders
    for folder in folders:
        about = sealed.read(folder / "provenance.json", "")
        assert about["sessions"] and all(session["command"] and session["commit"] for session in about["sessions"]), folder


def test_a_packed_folder_can_be_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = runpy.run_path(str(ROOT / "docs" / "pack_results.py"))["main"]
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "metrics.csv").write_text("numbers")
    (tmp_path / "run" / "checkpoints" / "best.ckpt").write_bytes(b"weights")
    assert pack([str(tmp_path / "run"), str(tmp_path / "a.tar.xz")]) == pack([str(tmp_path / "run"), str(tmp_path / "b.tar.xz")]) == 0
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "b.tar.xz").read_bytes()
    assert pack(["--check", str(tmp_path / "a.tar.xz")]) == 0
    assert "1 file" in capsys.readouterr().out
    (tmp_path / "b.tar.xz").write_bytes((tmp_path / "a.tar.xz").read_bytes()[:100])
    assert pack(["--check", str(tmp_path / "b.tar.xz")]) == 2
    assert pack([str(tmp_path / "nothing"), str(tmp_path / "c.tar.xz")]) == 2


@pytest.mark.parametrize("name", ["results.json", "table1.csv"])
def test_long_records_are_compressed(name: str, tmp_path: Path) -> None:
    record = runpy.run_path(str(ROOT / "docs" / "embed_results.py"))["record"]
    source, target = tmp_path / name, tmp_path / "target"
    target.mkdir()
    for length, copied in ((70_000, f"{source.name}.xz"), (10, source.name)):  # the second takes the place of the first
        source.write_text(json.dumps("1" * length))
        record(source, target)
        assert [path.name for path in target.iterdir()] == [copied]
        opened = lzma.open if copied.endswith("xz") else open
        with opened(target / copied, "rb") as file:
            assert file.read() == source.read_bytes()


def test_pictures_are_smaller_and_look_the_same(tmp_path: Path) -> None:
    picture = runpy.run_path(str(ROOT / "docs" / "embed_results.py"))["picture"]
    image = Image.effect_noise((2000, 100), 3).convert("RGB")
    image.save(tmp_path / "before.png")
    picture(tmp_path / "before.png", tmp_path / "after.png")
    with Image.open(tmp_path / "after.png") as after:
        assert after.size == (1400, 70)
        assert after.convert("L").resize((1, 1)).getpixel((0, 0)) == pytest.approx(
            image.convert("L").resize((1, 1)).getpixel((0, 0)), abs=3
        )
    assert (tmp_path / "after.png").stat().st_size < (tmp_path / "before.png").stat().st_size / 2


def test_records_of_other_models_are_kept() -> None:
    renewed = runpy.run_path(str(ROOT / "docs" / "embed_results.py"))["renewed"]
    old = [{"model": m, "scene": s, "value": k} for m, s, k in (("a", "x", 0), ("a", "x", 1), ("a", "y", 2), ("b", "x", 3))]
    new = [{"model": "a", "scene": s, "value": k} for s, k in (("x", 10), ("y", 11), ("y", 12))]
    assert [own["value"] for own in renewed(old, new)] == [10, 11, 12, 3]
    assert [own["value"] for own in renewed(old, [*new, {"model": "a", "scene": "z", "value": 13}])] == [10, 11, 12, 3, 13]
    with pytest.raises(ValueError, match="a x: not measured again"):
        renewed(old, new[1:])


@pytest.mark.slow
def test_a_figure_is_drawn_from_recorded_results(tmp_path: Path) -> None:
    draw = runpy.run_path(str(ROOT / "docs" / "embed_results.py"))["draw"]
    folder = tmp_path / "unseen_shipped"
    shutil.copytree(RESULTS / folder.name, folder)
    (folder / "reads_material.png").write_bytes(b"of an earlier run")
    command = "python docs/embed_results.py --draw unseen_shipped reads_material.png"
    old = sealed.read(folder / "provenance.json", "")
    trained = [session for session in old["sessions"] if session["command"] != command]
    sealed.write(folder / "provenance.json", {**old, "sessions": [*trained, {**trained[0], "command": command, "began": "earlier"}]})
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    draw.__globals__["RESULTS"] = tmp_path
    draw(folder.name, "reads_material.png")
    changed = {path.name for path in folder.iterdir() if before.get(path.name) != path.read_bytes()}
    assert changed == {"reads_material.png", "provenance.json"}
    with Image.open(folder / "reads_material.png") as image:
        assert image.width > 500
    about = sealed.read(folder / "provenance.json", "")
    assert (about["note"], about["sessions"][:-1]) == (old["note"], trained)
    assert about["sessions"][-1]["command"] == command and about["sessions"][-1]["began"] != "earlier"


def test_losses_are_drawn_from_recorded_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    draw = runpy.run_path(str(ROOT / "docs" / "training_losses.py"))["draw"]
    folder = tmp_path / "ablation_momentum_fluid_losses"
    shutil.copytree(RESULTS / folder.name, folder)
    (folder / "validation_loss.png").unlink(missing_ok=True)
    old = sealed.read(folder / "provenance.json", "")
    draw.__globals__["RESULTS"] = tmp_path
    draw(folder.name)
    with Image.open(folder / "validation_loss.png") as image:
        assert image.width > 2 * image.height  # two windows
    about = sealed.read(folder / "provenance.json", "")
    assert (about["note"], about["sessions"][0]) == (old["note"], old["sessions"][0])
    assert [session["command"] for session in about["sessions"][1:]] == [f"python docs/training_losses.py --draw {folder.name}"]

"""The headline of a checkpoint names what its own results in acceptance scenes and stress tests fail, and nothing else is believed."""

from __future__ import annotations

import json
import runpy
import shutil
from pathlib import Path

import pytest

from gpe_pl.files import sealed
from gpe_pl.learned.pretrained import checkpoint_path
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import NOT_MEASURED, NOT_TESTED, Check, Verdict, checksum, headline, path_beside, read, write

GOOD = Check("pile at rest: creep", True, "0.05 spacings/s", "0.04 spacings/s", "at most 0.1 spacings/s")
SHAKY = Check("22 a pile at rest", False, "farthest 3 spacings", "", "no node drifts")
BAD = Check("flat beam: tilt", False, "36°", "", "at most 3°")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "model.ckpt"
    path.write_bytes(b"weights")
    return path


def test_failures_lead(checkpoint: Path) -> None:
    assert headline(checkpoint) == NOT_MEASURED
    result = Verdict(checksum(checkpoint), [GOOD, BAD])
    write(path_beside(checkpoint, "acceptance"), result)
    assert read(path_beside(checkpoint, "acceptance")) == result
    assert headline(checkpoint) == "fails acceptance in 1 of 2 checks: flat beam: tilt 36°"
    write(path_beside(checkpoint, "acceptance"), Verdict(checksum(checkpoint), [GOOD]))
    assert headline(checkpoint) == "passes acceptance: 1 of 1 checks"
    write(path_beside(checkpoint, "stability"), Verdict(checksum(checkpoint), [SHAKY, GOOD]))
    assert headline(checkpoint) == "passes acceptance: 1 of 1 checks. Fails 1 of 2 stress tests: 22 a pile at rest"
    write(path_beside(checkpoint, "stability"), Verdict(checksum(checkpoint), [GOOD]))
    assert headline(checkpoint) == "passes acceptance: 1 of 1 checks. Passes 1 of 1 stress tests"
    write(path_beside(checkpoint, "stability"), Verdict("0" * 64, [GOOD]))
    assert f"checks. S{NOT_TESTED[1:]}: " in headline(checkpoint) and headline(checkpoint).endswith("another checkpoint")


def test_a_card_begins_with_the_latest_failures(checkpoint: Path, tmp_path: Path) -> None:
    judged = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "ship_model.py"))["judged"]
    judged.__globals__["FOLDER"] = tmp_path
    card, results = checkpoint.with_suffix(".md"), tmp_path / "results"
    results.mkdir()
    card.write_text("# model\n\nGPE for sand.\n\nTrained for long.\n")
    for checks, line in (([GOOD, BAD], "Fails acceptance in 1 of 2 checks: flat beam: tilt"), ([GOOD], "Passes acceptance: 1 of 1 checks")):
        write(results / "model.acceptance.json", Verdict(checksum(checkpoint), checks))
        judged(results)
        title, first, *rest = card.read_text().split("\n\n")
        assert title == "# model" and first.startswith(f"**{line}")
        assert ("what was tried" in first) == line.startswith("Fails")
        assert rest == ["GPE for sand.", "Trained for long.\n"]
    write(results / "model.stability.json", Verdict(checksum(checkpoint), [GOOD, SHAKY]))
    judged(results)
    first = card.read_text().split("\n\n")[1]
    assert first.startswith("**Passes acceptance: 1 of 1 checks. Fails 1 of 2 stress tests: 22 a pile at rest.**\nThe guide")
    checkpoint.write_bytes(b"other weights")
    with pytest.raises(ValueError, match="of another checkpoint"):
        judged(results)


@pytest.mark.slow
def test_a_card_says_that_its_model_has_static_friction(tmp_path: Path) -> None:
    rested = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "ship_model.py"))["rested"]
    rested.__globals__["FOLDER"] = tmp_path
    for path in (checkpoint_path("snow"), checkpoint_path("snow").with_suffix(".md")):
        shutil.copy(path, tmp_path)
    write(tmp_path / "snow.acceptance.json", Verdict(checksum(tmp_path / "snow.ckpt"), [GOOD]))
    weights = LearnedSimulator.from_checkpoint("snow").state_dict()
    for fraction, count in ((0.25, 1), (0.125, 1), (0.0, 0)):
        rested("snow", fraction)
        found, text = LearnedSimulator.from_checkpoint(tmp_path / "snow.ckpt"), (tmp_path / "snow.md").read_text()
        assert found.static_friction == fraction and all(bool((weights[key] == value).all()) for key, value in found.state_dict().items())
        assert text.count("static friction is") == text.count(f"static friction is {fraction:g}:") == count
        assert text.splitlines()[2] == f"**A{NOT_MEASURED[1:]}.**"  # of the model as it is now
        assert text.split("\n\n")[3:] == checkpoint_path("snow").with_suffix(".md").read_text().split("\n\n")[3:]


def test_results_of_another_checkpoint_are_not_shown(checkpoint: Path) -> None:
    write(path_beside(checkpoint, "acceptance"), Verdict(checksum(checkpoint), [GOOD]))
    checkpoint.write_bytes(b"other weights")
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ") and "another checkpoint" in headline(checkpoint)


@pytest.mark.parametrize("checks", [[{**vars(GOOD), "passed": "yes"}], [{"name": "x"}], "none", [{**vars(GOOD), "more": 1}]])
def test_values_of_other_types_are_refused_in_one_line(checkpoint: Path, checks: object) -> None:
    sealed.write(path_beside(checkpoint, "acceptance"), {"checkpoint": checksum(checkpoint), "checks": checks})
    with pytest.raises(sealed.SealError, match=r"model\.acceptance\.json: checks.*delete it, and run"):
        read(path_beside(checkpoint, "acceptance"))
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ")


def test_text_from_a_file_cannot_control_the_terminal(checkpoint: Path) -> None:
    hostile = Check("a\x1b[2J\nb", False, "1", "", "2")
    write(path_beside(checkpoint, "acceptance"), Verdict(checksum(checkpoint), [hostile]))
    assert headline(checkpoint).isprintable()
    path_beside(checkpoint, "acceptance").write_text(json.dumps({"checkpoint": "x"}))
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ")

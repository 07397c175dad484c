"""The headline of a checkpoint names what its own acceptance results fail, and nothing else is believed."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from gpe_pl.files import sealed
from gpe_pl.learned import acceptance
from gpe_pl.learned.acceptance import NOT_MEASURED, Acceptance, Check, headline, path_beside, read, write

GOOD = Check("pile at rest: creep", True, "0.05 spacings/s", "0.04 spacings/s", "at most 0.1 spacings/s")
BAD = Check("flat beam: tilt", False, "36°", "", "at most 3°")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "model.ckpt"
    path.write_bytes(b"weights")
    return path


def test_failures_lead(checkpoint: Path) -> None:
    assert headline(checkpoint) == NOT_MEASURED
    result = Acceptance(acceptance.checksum(checkpoint), [GOOD, BAD])
    write(path_beside(checkpoint), result)
    assert read(path_beside(checkpoint)) == result
    assert headline(checkpoint) == "fails acceptance in 1 of 2 checks: flat beam: tilt 36°"
    write(path_beside(checkpoint), Acceptance(acceptance.checksum(checkpoint), [GOOD]))
    assert headline(checkpoint) == "passes acceptance: 1 of 1 checks"


def test_a_card_begins_with_the_latest_failures(checkpoint: Path, tmp_path: Path) -> None:
    accepted = runpy.run_path(str(Path(__file__).parents[3] / "docs" / "ship_model.py"))["accepted"]
    accepted.__globals__["FOLDER"] = tmp_path
    card, results = checkpoint.with_suffix(".md"), tmp_path / "results"
    results.mkdir()
    card.write_text("# model\n\nGPE for sand.\n\nTrained for long.\n")
    for checks, line in (([GOOD, BAD], "Fails acceptance in 1 of 2 checks: flat beam: tilt"), ([GOOD], "Passes acceptance: 1 of 1 checks")):
        write(results / "model.acceptance.json", Acceptance(acceptance.checksum(checkpoint), checks))
        accepted(results)
        title, first, *rest = card.read_text().split("\n\n")
        assert title == "# model" and first.startswith(f"**{line}")
        assert rest == ["GPE for sand.", "Trained for long.\n"]
    checkpoint.write_bytes(b"other weights")
    with pytest.raises(ValueError, match="of another checkpoint"):
        accepted(results)


def test_results_of_another_checkpoint_are_not_shown(checkpoint: Path) -> None:
    write(path_beside(checkpoint), Acceptance(acceptance.checksum(checkpoint), [GOOD]))
    checkpoint.write_bytes(b"other weights")
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ") and "another checkpoint" in headline(checkpoint)


@pytest.mark.parametrize("checks", [[{**vars(GOOD), "passed": "yes"}], [{"name": "x"}], "none", [{**vars(GOOD), "more": 1}]])
def test_values_of_other_types_are_refused_in_one_line(checkpoint: Path, checks: object) -> None:
    sealed.write(path_beside(checkpoint), {"checkpoint": acceptance.checksum(checkpoint), "checks": checks})
    with pytest.raises(sealed.SealError, match=r"model\.acceptance\.json: checks.*delete it, and run"):
        read(path_beside(checkpoint))
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ")


def test_text_from_a_file_cannot_control_the_terminal(checkpoint: Path) -> None:
    hostile = Check("a\x1b[2J\nb", False, "1", "", "2")
    write(path_beside(checkpoint), Acceptance(acceptance.checksum(checkpoint), [hostile]))
    assert headline(checkpoint).isprintable()
    path_beside(checkpoint).write_text(json.dumps({"checkpoint": "x"}))
    assert headline(checkpoint).startswith(f"{NOT_MEASURED}: ")

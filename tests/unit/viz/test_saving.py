"""Figures are also written as vector graphics on request."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from gpe_pl.viz.saving import VARIABLE, FigureFormatError, save_figure


@pytest.mark.parametrize(("asked", "expected"), [("", ["a.png"]), ("svg", ["a.png", "a.svg"]), ("PDF, svg", ["a.pdf", "a.png", "a.svg"])])
def test_figures_are_also_written_in_the_formats_that_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str, expected: list[str]
) -> None:
    monkeypatch.setenv(VARIABLE, asked)
    save_figure(Figure(), tmp_path / "a.png", dpi=20)
    assert sorted(path.name for path in tmp_path.iterdir()) == expected
    starts = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
    assert all(path.read_bytes().startswith(starts[path.suffix]) for path in tmp_path.iterdir())


def test_a_figure_of_another_kind_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "svg")
    save_figure(Figure(), tmp_path / "a.pdf")
    assert [path.name for path in tmp_path.iterdir()] == ["a.pdf"]


def test_an_unknown_format_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "svg,eps")
    with pytest.raises(FigureFormatError, match="GPE_FIGURES=svg,eps: 'eps' must be svg or pdf, or both"):
        save_figure(Figure(), tmp_path / "a.png")
    assert not [*tmp_path.iterdir()]

"""In a running notebook, trajectories are viewers and progress is a widget."""

from __future__ import annotations

from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

CELLS = (
    "from gpe_pl import Scene\nfilm = Scene(box=(1.0, 1.0)).block('sand', at=(0.1, 0.0), size=(0.08, 0.16)).predict('sand', 0.02)",
    "film.first",
    "film",
)


@pytest.mark.notebook
def test_trajectories_are_viewers_and_progress_is_a_widget() -> None:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    progress, trajectory, film = (cell["outputs"] for cell in notebook.cells)
    assert any("application/vnd.jupyter.widget-view+json" in output.get("data", {}) for output in progress), progress
    assert not any('install "ipywidgets"' in str(output) for output in progress)
    for (output,) in (trajectory, film):
        page: Any = output["data"]["text/html"]
        assert "<iframe srcdoc=" in page and "friction angle" in page

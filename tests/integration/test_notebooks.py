"""Every notebook runs from start to end, on results made as a user makes them, and is stored without outputs."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import pytest
from filelock import FileLock

from gpe_pl.evaluation.metric_rows import LEARNED, Row, write_rows
from gpe_pl.files import sealed
from gpe_pl.learned.ensemble import LearnedEnsemble

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MOMENTUM = ROOT / "notebooks" / "momentum_ablation.ipynb"
MAX_CELLS = 12

# Four steps of training end within the warm-up, and a rollout may well go wrong after them; two training scenes have few of the parameters that are asked
# for; models that come with the package may be older than the solver.
TRUE_OF_MINIATURES = re.compile(
    r"training.warmup_steps=100: training ends at step 4, |"
    r"(val|test|test_unseen) \d+ stopped: \w+, frame \d+: |outside the training data: (friction_angle of sand is |the ground truth is from version )"
)

# Everything as small as it goes: every split and both kinds of unseen parameters, few particles, frames and steps.
DATA = (
    *("data.sizes.tiny.num_train=2", "data.sizes.tiny.num_val=1", "data.sizes.tiny.num_test=2", "data.sizes.tiny.num_test_unseen=2"),
    *("data.sizes.tiny.num_frames=30", "data.sizes.tiny.d2.num_particles=40"),
)
RUN = (
    *("model.hidden_channels=8", "model.num_message_passing_steps=1"),
    *("training.num_steps=4", "training.val_interval=2", "training.warmup_steps=0", "training.compile=off"),
    *("training.num_val_rollouts=1", "training.val_rollout_steps=5"),
    *("evaluation.horizons=[0.025,0.1]", "evaluation.num_pictures=0", "trainer.progress=false"),
)
CANYON = (
    "data.sizes.tiny.num_frames=12",
    "data.sizes.tiny.d3.num_particles=60",
    "training.budget_minutes=null",
    "evaluation.splits=[test]",
)
BENCHMARK = ("suite.factors=[2.0]", "suite.num_trajectories=1", "suite.horizons=[5,20]")

# Notebooks that read any run take those of the ablation, and train for as many steps as it.
SETTINGS = {"GPE_NAME": "ablation_momentum", "GPE_STEPS": "4"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Make a folder with ``data`` and ``runs`` for the notebooks, once for all workers; the others wait."""
    own = tmp_path_factory.getbasetemp()
    folder = (own if worker_id == "master" else own.parent) / "notebooks"
    with FileLock(folder.with_suffix(".lock")):
        if not (folder / "made").exists():
            _make_results(folder)
            (folder / "made").touch()
    return folder


def _make_results(folder: Path) -> None:
    """Run miniatures of two experiments and of a benchmark."""
    in_one_process = "hydra/launcher=basic"  # eight processes would import PyTorch for seconds to train for one
    _command(folder, "fit", "experiment=ablation_momentum", in_one_process, *DATA, *RUN)
    case = f"suite.cases={{sand: {{overrides: {json.dumps(['data=sand', 'size=tiny', *DATA])}}}}}"
    runs = f"suite.runs=[{folder / 'runs' / 'ablation_momentum'}]"
    _command(folder, "benchmark", "suite=runtime_vs_error", runs, "suite.cases=null", case, *BENCHMARK)
    _command(folder, "fit", "experiment=canyon", *DATA[:-1], *CANYON, *RUN)


def _command(folder: Path, name: str, *overrides: str) -> None:
    command = [sys.executable, "-m", f"gpe_pl.{name}", *overrides, f"paths.data={folder / 'data'}", f"paths.runs={folder / 'runs'}"]
    child = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=_environment(), check=False)
    assert child.returncode == 0, child.stdout[-2000:] + child.stderr[-2000:]


def _environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}


def _execute(path: Path, folder: Path, runs: Path, data: Path) -> Any:
    """Execute a copy of a notebook with the running interpreter; return the copy with its outputs, which also stays in ``folder``."""
    from ipykernel.kernelspec import write_kernel_spec
    from nbclient import NotebookClient

    write_kernel_spec(folder / "jupyter" / "kernels" / "python3")  # one that a user has installed may be another interpreter
    copy = Path(shutil.copy(path, folder))
    notebook = nbformat.read(copy, as_version=4)
    own = {
        "JUPYTER_PATH": folder / "jupyter",
        "IPYTHONDIR": folder / "ipython",
        "GPE_RUNS": runs,
        "GPE_DATA": data,
        "GPE_WORK": folder / "work",
    }
    with pytest.MonkeyPatch.context() as monkeypatch:
        for key, value in {**_environment(), **SETTINGS, **own}.items():
            monkeypatch.setenv(key, str(value))
        client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}})
        try:
            client.execute()
        finally:
            nbformat.write(notebook, copy)
    return notebook


@pytest.fixture(scope="module")
def executed(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Any]:
    """Function that returns a notebook with its outputs on the miniature; it executes each notebook once."""
    return functools.cache(lambda path: _execute(path, tmp_path_factory.mktemp(path.stem), results / "runs", results / "data"))


def _outputs(notebook: Any) -> list[Any]:
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


@pytest.mark.notebook
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs_without_a_warning(path: Path, executed: Callable[[Path], Any]) -> None:
    before = path.read_bytes()
    errors = "".join(output.text for output in _outputs(executed(path)) if output.get("name") == "stderr")
    assert [line for line in errors.splitlines() if not TRUE_OF_MINIATURES.match(line)] == []
    assert path.read_bytes() == before


@pytest.mark.notebook
def test_momentum_ablation_shows_all_interactions(executed: Callable[[Path], Any]) -> None:
    data = [output.data for output in _outputs(executed(MOMENTUM)) if "data" in output]
    assert sum("image/png" in d for d in data) == 3
    tables = [d["text/html"] for d in data if "text/html" in d]
    assert len(tables) == 3
    for interaction in ("directed", "negated", "odd", "odd_even"):
        assert all(f">{interaction}<" in table for table in tables)


@pytest.mark.notebook
def test_unseen_materials_clamps_parameters_as_the_evaluation_of_its_runs_did(executed: Callable[[Path], Any]) -> None:
    said = "The model gets the nearest trained value outside the trained range, as in its evaluation."
    assert any(said in output.get("text", "") for output in _outputs(executed(ROOT / "notebooks" / "unseen_materials.ipynb")))


def _first_code(path: Path) -> str:
    """Return the first cell of code without the commands of IPython."""
    source = next(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code")
    return "\n".join(line for line in source.splitlines() if not line.startswith("%"))


def _run_first_code(path: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Execute the first cell of code in this process. A kernel would import everything again."""
    monkeypatch.setenv("GPE_RUNS", str(runs))
    exec(_first_code(path), {})


def _write_run(folder: Path, seed: int, **others: Any) -> None:
    """Write the files of a finished run that notebooks read first. ``others`` are settings by group."""
    folder.mkdir(parents=True)
    config = {"data": {"name": "sand"}, "model": {"_target_": "gpe_pl.models.gpe.GPE"}, "training": {"num_steps": 10}}
    settings = {name: config.get(name, {}) | others.get(name, {}) for name in {**config, **others}}
    sealed.write(folder / "config.json", {"seed": seed, **settings})
    write_rows(folder / "metrics.csv", [Row(LEARNED, "test_unseen", 0, "interpolated", 20.0, "rollout_mse", "full", 1.0)])


def test_models_that_disagree_differ_in_nothing_but_the_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = list[list[str]]()
    monkeypatch.setattr(LearnedEnsemble, "from_checkpoints", lambda folders: taken.append([folder.name for folder in folders]))
    monkeypatch.setenv("GPE_NAME", "sweep")
    active = ROOT / "notebooks" / "active.ipynb"
    for name, seed, settings in (("a", 0, {"num_steps": 10}), ("b", 0, {"num_steps": 20}), ("c", 1, {"num_steps": 30})):
        _write_run(tmp_path / "sweep" / name, seed, training=settings)
    _write_run(tmp_path / "sweep" / "again", 0, training={"num_steps": 20})
    with pytest.raises(FileNotFoundError, match="no two runs of one model with different seeds"):
        _run_first_code(active, tmp_path, monkeypatch)
    _write_run(tmp_path / "sweep" / "d", 2, training={"num_steps": 30})
    _run_first_code(active, tmp_path, monkeypatch)
    assert taken == [["c", "d"]]


def test_discs_of_own_data_stay_within_the_bounds_of_the_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPE_WORK", str(tmp_path))
    functions, _, _ = _first_code(ROOT / "notebooks" / "own_data.ipynb").partition("arrays =")
    names: dict[str, Any] = {}
    usual = "((0.0, 1.0), (0.0, 1.0))"
    assert functions.count(usual) == 1
    exec(functions.replace(usual, "((3.0, 4.0), (5.0, 6.0))"), names)
    pos = names["discs"](0, num_discs=8, num_frames=30)
    assert ((pos > (3.0, 5.0)) & (pos < (4.0, 6.0))).all()


def test_unseen_materials_refuses_scenes_of_several_materials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPE_NAME", "sweep")
    parameters = {name: {"seen": [20.0], "extrapolated": [10.0]} for name in ("sand", "snow")}
    _write_run(tmp_path / "sweep" / "mixed", 0, data={"name": "mixed", "parameters": parameters}, size={"name": "tiny"})
    with pytest.raises(ValueError, match=r"scenes of several materials \(sand, snow\), which have no one parameter.*GPE_NAME"):
        _run_first_code(ROOT / "notebooks" / "unseen_materials.ipynb", tmp_path, monkeypatch)


def test_momentum_ablation_without_results_says_how_to_make_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="no finished ablation.*make fit") as error:
        _run_first_code(MOMENTUM, tmp_path / "runs", monkeypatch)
    assert str(tmp_path / "runs" / "ablation_momentum") in str(error.value)


@pytest.mark.notebook
def test_momentum_ablation_half_done_names_what_is_missing(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = shutil.copytree(results / "runs", tmp_path / "runs")
    for path in runs.rglob("model.interaction=odd"):
        shutil.rmtree(path)
    with pytest.raises(ValueError, match="no finished run of odd. Run `make fit` again"):
        _run_first_code(MOMENTUM, runs, monkeypatch)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_small_and_stored_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert len(notebook.cells) <= MAX_CELLS
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert notebook.metadata.kernelspec.name == "python3"


def test_the_momentum_ablation_has_a_notebook() -> None:
    assert MOMENTUM in NOTEBOOKS

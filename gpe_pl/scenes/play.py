"""Command ``gpe play MODEL``: serve the page on which a model runs in the browser, or write it to a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.files.destinations import folder_fault
from gpe_pl.learned.pretrained import model_name, names
from gpe_pl.system.command_line import ArgumentFault, command, integer, truth

if TYPE_CHECKING:
    from gpe_pl.export.play_page import SolverFilm
    from gpe_pl.learned.simulator import LearnedSimulator

SHIPPED = ("sand", "snow")
"""Shipped models that the page can compute."""
NUM_FRAMES = 200
"""Number of frames of a film."""

ABOUT = f"""Play with a model in the browser: drag and throw blocks, move obstacles, slide the material parameter. gpe play [MODEL] [KEY=VALUE …]

  gpe play                          the shipped models {" and ".join(SHIPPED)}
  gpe play sand films=2             one of them, with two scenes beside the solver
  gpe play runs/mine folder=page    writes the page of your run; any file server can serve it, without Python

Settings (default)
  films       scenes of the training's kind with a film of the solver, for each model (0)
  folder      write the page into this folder and end; otherwise the page is served until Ctrl-C
  port        port of the server; 0 takes any free one (8000)
  open        open the page in the browser (true)"""

KEYS: dict[str, Callable[[str], Any]] = {"films": integer(0, 20), "folder": Path, "port": integer(0, 65535), "open": truth}


class PortFault(GpeError, OSError):
    """Raised when a port cannot be used."""


def films_of(simulator: LearnedSimulator, count: int) -> list[SolverFilm]:
    """Return films of random scenes like those of the training, with parameters in the middle of the trained range.

    Raises:
        NotRecorded: the model was trained on data that this package did not simulate.
    """
    from gpe_pl.export.play_page import SolverFilm
    from gpe_pl.scenes.recorded import recorded_scene, recorded_solver
    from gpe_pl.scenes.rollouts import middle_values, solved

    metadata, first = simulator.builder.metadata, simulator.builder.config.history
    scene, solver, films = recorded_scene(metadata), recorded_solver(metadata), []
    for seed in range(count):
        about = replace(metadata, seed=seed, split="", solver_version=solver.version)
        state = scene.sample(middle_values(simulator), seed)
        films.append(
            SolverFilm(f"scene {seed + 1} of the solver", solved(solver, state, about, first + NUM_FRAMES, f"film {seed + 1} of {count}"))
        )
    return films


def write(folder: Path, models: list[str], num_films: int) -> Path:
    """Write the page of some models, each with films of the solver; return the path of its ``index.html``."""
    from gpe_pl.export.play_model import check
    from gpe_pl.export.play_page import write_page
    from gpe_pl.learned.simulator import LearnedSimulator

    simulators = {model_name(model, "."): LearnedSimulator.from_checkpoint(model) for model in models}
    for simulator in simulators.values():
        check(simulator)
    return write_page(folder, simulators, {name: films_of(simulator, num_films) for name, simulator in simulators.items()})


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None: ...


def server(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server of a folder's files for this computer alone. Port 0 takes any free one.

    Raises:
        PortFault: the port cannot be used.
    """
    try:
        return ThreadingHTTPServer(("127.0.0.1", port), partial(_Quiet, directory=str(folder)))
    except OSError as error:
        raise PortFault(f"port={port}: {error.strerror}; choose another one, or port=0 for any free one") from None


def _serve(serving: ThreadingHTTPServer, is_opened: bool) -> None:
    from gpe_pl.viz.browser import open_address

    address = f"http://127.0.0.1:{serving.server_address[1]}/"
    print(f"{address} (Ctrl-C ends)", flush=True)
    if is_opened and not open_address(address):
        print("no browser here; write the page with folder=… and open its index.html elsewhere", flush=True)
    serving.serve_forever()


def run(model: str | None, values: dict[str, Any]) -> None:
    """Check the model's name, and write or serve the page."""
    if model is not None and not (model in names() or Path(model).exists()):
        raise ArgumentFault(
            f"gpe play {model}: name a shipped model ({', '.join(SHIPPED)}), or the folder of a run{did_you_mean(model, SHIPPED)}"
        )
    if "folder" in values and (fault := folder_fault(values["folder"])):
        raise ArgumentFault(f"folder={values['folder']}: {fault}; name another folder")
    models, num_films = [model] if model else [*SHIPPED], values.get("films", 0)
    if "folder" in values:
        print(write(values["folder"], models, num_films))
        return
    with tempfile.TemporaryDirectory(prefix="gpe_pl_") as folder, server(Path(folder), values.get("port", 8000)) as serving:
        write(Path(folder), models, num_films)
        _serve(serving, values.get("open", True))


main = command(run, ABOUT, "model", KEYS)

if __name__ == "__main__":
    main()

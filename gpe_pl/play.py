"""Command ``python -m gpe_pl.play [MODEL …]``: serve the page on which a learned model runs in the browser, or write it to a folder.

A model is the name of a shipped model, a checkpoint or the folder of a run. Press Ctrl-C to end. With ``--folder``, the command writes the page and ends; any
file server can serve this folder, without Python and without a network.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from gpe_pl.errors import GpeError
from gpe_pl.printable import speak_utf8

if TYPE_CHECKING:
    from http.server import ThreadingHTTPServer

SHIPPED = ("sand", "snow")
"""Shipped models that the page can compute."""
NUM_FRAMES = 200
"""Number of frames of a film."""


def server(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server of a folder's files for this computer alone. Port 0 takes any free one.

    Raises:
        GpeError: the port is not free.
    """
    from functools import partial
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

    try:
        return ThreadingHTTPServer(("127.0.0.1", port), partial(Quiet, directory=str(folder)))
    except OSError as error:
        raise GpeError(f"--port {port}: {error.strerror}; choose another one, or 0 for any free one") from None


def write(folder: Path, models: list[str], num_films: int) -> Path:
    """Write the page of some models, each with films of the solver; return the path of its ``index.html``."""
    from gpe_pl.export.play_films import films_of
    from gpe_pl.export.play_page import write_page
    from gpe_pl.learned.simulator import LearnedSimulator

    simulators = {Path(model).stem or model: LearnedSimulator.from_checkpoint(model) for model in models}
    if len(simulators) < len(models):
        raise GpeError(f"{', '.join(models)}: two of them have the same name; give files different names")
    films = {name: films_of(simulator, num_films, NUM_FRAMES) for name, simulator in simulators.items()} if num_films else {}
    return write_page(folder, simulators, films)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m gpe_pl.play", description="Play with a learned model in the browser.")
    parser.add_argument("models", nargs="*", metavar="MODEL", help=f"shipped model, checkpoint or folder of a run ({' '.join(SHIPPED)})")
    parser.add_argument("--films", type=int, default=0, metavar="N", help="scenes with a film of the solver, some seconds each (0)")
    parser.add_argument("--folder", type=Path, help="write the page into this folder, and end")
    parser.add_argument("--port", type=int, default=8000, help="port of the server; 0 takes any free one (8000)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the page")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit status."""
    options = _parser().parse_args(arguments)
    speak_utf8()
    models = options.models or list(SHIPPED)
    try:
        if options.folder is not None:
            print(write(options.folder, models, options.films))
            return 0
        with tempfile.TemporaryDirectory(prefix="gpe_pl_") as folder:
            write(Path(folder), models, options.films)
            with server(Path(folder), options.port) as serving:
                address = f"http://127.0.0.1:{serving.server_address[1]}/"
                print(f"{address} shows {', '.join(models)}; Ctrl-C ends", flush=True)
                if not options.no_browser:
                    webbrowser.open(address)
                serving.serve_forever()
    except GpeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())

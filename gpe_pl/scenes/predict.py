"""Command ``gpe predict scene.yaml checkpoint=sand``: roll a model, a solver or both out in a scene file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gpe_pl.learned.pretrained import names
from gpe_pl.system.command_line import ArgumentFault, command, number, truth

ABOUT = f"""Roll a model out in a scene of yours: gpe predict SCENE.yaml [KEY=VALUE …]

  gpe predict scene.yaml checkpoint=sand                a shipped model: {", ".join(names())}
  gpe predict scene.yaml checkpoint=runs/mine solve=true     beside the solver that made its training data

Settings (default)
  checkpoint   shipped model, folder of a run, or path of a checkpoint (the shipped model of the material)
  seconds      length of the film (1)
  solve        also run the solver, and compare (false)
  file         viewer that is written; .png, .svg, .pdf, .gif, .mp4 and .npz (a file per rollout) also work (SCENE.html)
  open         open the viewer in the browser (true)

A scene file looks like this; the guide, "A scene of your own", lists all keys:

  box: [1.0, 1.0]
  bodies:
    - {{block: sand, at: [0.1, 0.0], size: [0.2, 0.4], friction_angle: 30}}
  obstacles:
    - {{circle: [0.7, 0.2], radius: 0.1}}
    - {{mesh: part.stl, at: [0.4, 0.0], size: 0.2}}"""

KEYS: dict[str, Callable[[str], Any]] = {"checkpoint": str, "seconds": number(1e-3, 3600.0), "solve": truth, "file": Path, "open": truth}


def run(word: str | None, values: dict[str, Any]) -> None:
    """Roll the scene out, write the film, and open it. A scene with faults is drawn to a picture."""
    from gpe_pl.scenes.film import check_file
    from gpe_pl.scenes.picture import draw
    from gpe_pl.scenes.scene import SceneFault
    from gpe_pl.scenes.scene_file import read_scene
    from gpe_pl.viz.browser import open_page

    if word is None:
        raise ArgumentFault("gpe predict: name a scene file, such as scene.yaml; `gpe predict --help` shows one")
    file = values.get("file") or Path(f"{Path(word).stem}.html")
    check_file(file)
    scene = read_scene(word)
    roll_out = scene.compare if values.get("solve", False) else scene.predict
    try:
        film = roll_out(values.get("checkpoint"), values.get("seconds", 1.0))
    except SceneFault as fault:
        if fault.scene is None:
            raise
        picture = file.with_name(f"{Path(word).stem}_faults.png")
        draw(scene, fault.faults, picture)
        raise SceneFault({**fault.faults, f"see {picture}": "faults are red"}) from None
    print(film.summary())
    film.write(file)
    print(*film.files(file), sep="\n")
    if values.get("open", True) and file.suffix == ".html" and not open_page(file):
        print("no browser here; copy the file, which needs nothing else, and open it elsewhere")


main = command(run, ABOUT, "scene file", KEYS)

if __name__ == "__main__":
    main()

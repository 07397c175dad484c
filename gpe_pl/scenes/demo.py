"""Command ``gpe demo MODEL``: a scene like those of the training, rolled out by the model and its solver, in a viewer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from gpe_pl.errors.printable import did_you_mean
from gpe_pl.learned.pretrained import model_name, names
from gpe_pl.system.command_line import ArgumentFault, command, integer, number, truth

ABOUT = f"""Show a model beside its solver, in a scene like those of its training: gpe demo MODEL [KEY=VALUE …]

  gpe demo sand                     a shipped model: {", ".join(names())}
  gpe demo runs/mine seed=3         a run of yours

Settings (default)
  parameter   value of the material's first parameter (middle of the trained range)
  seconds     length of the film (1)
  seed        number of the scene (0)
  file        viewer that is written; .png, .svg, .pdf, .gif, .mp4 and .npz (a file per rollout) also work (demo_MODEL.html)
  open        open the viewer in the browser (true)"""

KEYS: dict[str, Callable[[str], Any]] = {
    "parameter": number(0.0, 1e12),
    "seconds": number(1e-3, 3600.0),
    "seed": integer(0, 2**31),
    "file": Path,
    "open": truth,
}


def demo(model: str, parameter: float | None = None, seconds: float = 1.0, seed: int = 0, file: Path | None = None, **_: Any) -> list[Path]:
    """Roll a model and its solver out in one scene, and write the film; returns its files.

    Raises:
        NotRecorded: the model was trained on data that this package did not simulate.
        SceneFault: the scene cannot be solved, such as with an impossible parameter.
    """
    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.scenes.film import Film, check_file
    from gpe_pl.scenes.recorded import recorded_scene, recorded_solver
    from gpe_pl.scenes.rollouts import middle_values, predicted, solved
    from gpe_pl.solvers.materials import limits_fault

    name = model_name(model, ".")
    file = file or Path(f"demo_{name}.html")
    check_file(file)
    simulator = LearnedSimulator.from_checkpoint(model)
    trained = simulator.builder.metadata
    scene, solver = recorded_scene(trained), recorded_solver(trained)
    values = middle_values(simulator)
    if parameter is not None and len(values) > 1:
        raise ArgumentFault(f"parameter={parameter:g}: {name} knows {' and '.join(values)}, so it is not clear whose parameter this is")
    for material, own in values.items():
        first = trained.parameters_of(material)[0]
        own[first.name] = own[first.name] if parameter is None else parameter
        if fault := limits_fault(first, own[first.name]):
            raise ArgumentFault(f"parameter={parameter:g}: {fault}")
    state = scene.sample(values, seed)
    metadata = replace(trained, split="", seed=seed, bounds=scene.bounds, gravity=scene.gravity)
    num_frames = max(2, round(seconds / metadata.frame_dt))
    prediction = predicted(simulator, state, metadata, num_frames, f"model {name}")
    film = Film(
        f"{name}: a scene like those of the training",
        solved(solver, state, metadata, num_frames, f"solver {solver.name}"),
        {name: prediction},
    )
    print(film.summary())
    film.write(file)
    return film.files(file)


def run(model: str | None, values: dict[str, Any]) -> None:
    """Check the model's name, write the film, and open it."""
    from gpe_pl.viz.browser import open_page

    if model is None or not (model in names() or Path(model).exists()):
        raise ArgumentFault(
            f"gpe demo{' ' + model if model else ''}: name a shipped model ({', '.join(names())}), or the folder of a run"
            f"{did_you_mean(model, names()) if model else ''}"
        )
    path, *others = demo(model, **values)
    print(path, *others, sep="\n")
    if values.get("open", True) and path.suffix == ".html" and not open_page(path):
        print("no browser here; copy the file, which needs nothing else, and open it elsewhere")


main = command(run, ABOUT, "model", KEYS)

if __name__ == "__main__":
    main()

"""Films of the solver for the page: random scenes of a model's training data, solved again."""

from __future__ import annotations

import json
from dataclasses import replace

from pydantic import TypeAdapter, ValidationError

from gpe_pl.export.play_model import PageError
from gpe_pl.export.play_page import Film
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import rollout
from gpe_pl.solvers.mpm.solver import MPM
from gpe_pl.solvers.scenes import BodyScene

FIRST_SEED = 1000
"""Seed of the first scene."""


def films_of(simulator: LearnedSimulator, count: int, num_frames: int) -> list[Film]:
    """Return films of random scenes, with the settings of scene and solver that the metadata record and parameters in the middle of the trained range.

    Args:
        simulator: model of bodies of particles whose data MPM computed.
        count: number of films.
        num_frames: number of frames of each, after those that the model needs before its start.

    Raises:
        PageError: the metadata do not describe such data.
    """
    metadata, first = simulator.builder.metadata, simulator.builder.config.history
    try:
        recorded = json.loads(metadata.config)
        settings = {part: {k: v for k, v in recorded[part].items() if k not in ("kind", "name", "version")} for part in ("scene", "solver")}
        scene, solver = TypeAdapter(BodyScene).validate_python(settings["scene"]), TypeAdapter(MPM).validate_python(settings["solver"])
    except (ValueError, KeyError, AttributeError, ValidationError):
        raise PageError(f"films need a model of bodies of particles that MPM computed; {metadata.dataset!r} has other data") from None
    values = {}
    for material, trained in simulator.trained_ranges():
        names = [p.name for p in simulator.builder.spec.parameters[material]]
        values[material] = dict(zip(names, trained.mean(dim=0).tolist(), strict=True))
    films = []
    for k in range(count):
        about = replace(metadata, seed=FIRST_SEED + k, split="", solver_version=solver.version)
        trajectory = rollout(solver, scene.sample(values, FIRST_SEED + k), first + num_frames - 1, about)
        films.append(Film(f"scene {k + 1} of the solver", trajectory))
    return films

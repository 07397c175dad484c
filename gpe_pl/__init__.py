"""Learned simulators of particles and meshes: the Graph-based Physics Engine (GPE) and its baselines.

Import the most common names from here. This example compares a trained model with the ground truth in a scene with a parameter that training did not have::

    from gpe_pl import LearnedSimulator, dataset, generate_trajectory, roll_out, rollout_figure
    simulator = LearnedSimulator.from_checkpoint("sand")  # a shipped model, or the path of a checkpoint
    truth = generate_trajectory(dataset("data=sand", "size=small"), split="test", index=0, values={"sand": 27.5})
    prediction = roll_out(simulator, simulator.initial_state(truth, frame=5), num_steps=100, metadata=truth.metadata)
    rollout_figure(truth.frames(5, 106), {"GPE": prediction}).savefig("rollout.png")

A name is imported when it is first used, so a program imports only what it needs. No name is that of a module, whose import would replace it:
``roll_out`` is the function ``rollout.loop.rollout``.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gpe_pl.system import early_interrupts
from gpe_pl.system.caches import prepare

if TYPE_CHECKING:
    from gpe_pl.config.datasets import dataset as dataset
    from gpe_pl.data.ground_truth import generate_trajectory as generate_trajectory
    from gpe_pl.data.importers.assemble import save_dataset as save_dataset
    from gpe_pl.errors import GpeError as GpeError
    from gpe_pl.evaluation.identification.scene import identify_parameters as identify_parameters
    from gpe_pl.export.program import export_model as export_model
    from gpe_pl.export.trajectories import write_npz as write_npz
    from gpe_pl.export.trajectories import write_vtk as write_vtk
    from gpe_pl.geometry.shapes import domain_walls as domain_walls
    from gpe_pl.learned.banded import roll_out_with_bands as roll_out_with_bands
    from gpe_pl.learned.bands import read as read_bands  # noqa: F401
    from gpe_pl.learned.ensemble import LearnedEnsemble as LearnedEnsemble
    from gpe_pl.learned.simulator import LearnedSimulator as LearnedSimulator
    from gpe_pl.metrics.rollouts import rollout_metrics as rollout_metrics
    from gpe_pl.rollout.containment import Contained as Contained
    from gpe_pl.rollout.loop import rollout as roll_out  # noqa: F401
    from gpe_pl.scenes.obstacles import Circle as Circle
    from gpe_pl.scenes.scene import Scene as Scene
    from gpe_pl.trajectory.boundary import Boundary as Boundary
    from gpe_pl.trajectory.state import State as State
    from gpe_pl.trajectory.store import iter_trajectories as iter_trajectories
    from gpe_pl.trajectory.store import read_trajectory as read_trajectory
    from gpe_pl.trajectory.trajectory import Metadata as Metadata
    from gpe_pl.trajectory.trajectory import Trajectory as Trajectory
    from gpe_pl.viz.figures import rollout_figure as rollout_figure
    from gpe_pl.viz.video import write_animation as write_animation
    from gpe_pl.viz.viewer import write_viewer as write_viewer

early_interrupts.begin()
prepare()  # before Numba and Matplotlib are imported
if "IPython" in sys.modules and (_shell := sys.modules["IPython"].get_ipython()) is not None:  # a notebook shows trajectories as viewers
    _shell.display_formatter.formatters["text/html"].for_type_by_name(
        "gpe_pl.trajectory.trajectory", "Trajectory", lambda trajectory: import_module("gpe_pl.viz.notebook").embedded_viewer(trajectory)
    )

_MODULES = {
    "Boundary": "trajectory.boundary",
    "Circle": "scenes.obstacles",
    "Contained": "rollout.containment",
    "GpeError": "errors",
    "LearnedEnsemble": "learned.ensemble",
    "LearnedSimulator": "learned.simulator",
    "Metadata": "trajectory.trajectory",
    "Scene": "scenes.scene",
    "State": "trajectory.state",
    "Trajectory": "trajectory.trajectory",
    "dataset": "config.datasets",
    "domain_walls": "geometry.shapes",
    "export_model": "export.program",
    "generate_trajectory": "data.ground_truth",
    "identify_parameters": "evaluation.identification.scene",
    "iter_trajectories": "trajectory.store",
    "read_bands": "learned.bands",
    "read_trajectory": "trajectory.store",
    "roll_out": "rollout.loop",
    "roll_out_with_bands": "learned.banded",
    "rollout_figure": "viz.figures",
    "rollout_metrics": "metrics.rollouts",
    "save_dataset": "data.importers.assemble",
    "write_animation": "viz.video",
    "write_npz": "export.trajectories",
    "write_viewer": "viz.viewer",
    "write_vtk": "export.trajectories",
}
_NAMES_THERE = {"read_bands": "read", "roll_out": "rollout"}

__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'gpe_pl' has no attribute {name!r}; it has {', '.join(_MODULES)}")
    value = getattr(import_module(f"gpe_pl.{_MODULES[name]}"), _NAMES_THERE.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})

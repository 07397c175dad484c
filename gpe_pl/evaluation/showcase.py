"""Showcase: a rollout in a scene far larger than those in training, without ground truth.

The run measures its cost and signs of errors, such as particles in walls, and draws pictures.

Memory does not grow with the length of the rollout, because only the frames of the animation are kept.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
from pydantic import Field

from gpe_pl.files.atomic import replace_text
from gpe_pl.geometry.shapes import signed_distance, surface_tolerance
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard, unsound
from gpe_pl.rollout.loop import Simulator, Start, frames
from gpe_pl.schema import MATERIALS, MaterialValues, parameters_by_name
from gpe_pl.solvers.materials import limits_fault
from gpe_pl.solvers.scenes import SceneDistribution, describe
from gpe_pl.system.machine import environment, peak_resident
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Termination, Trajectory
from gpe_pl.viz.saving import save_figure

MAX_PICTURES = 60
"""Maximum number of frames of the animation."""
MAX_SPEED_FACTOR = 2.0
"""A node is too fast if its speed exceeds this factor times that after a free fall through the whole domain."""
DEPTH = 1e-3
"""Depth in a solid [rest spacings] from which a node counts as outside in a rollout without containment."""


@dataclass(frozen=True)
class ShowcaseSettings:
    """Settings of a showcase.

    Attributes:
        num_steps: length of the rollout [frames].
        num_uncontained_steps: length [frames] of a second rollout without containment, which shows what it corrects.
        values: parameters of each material, in the units of ``schema.MATERIALS``: a number for the first one, several by name.
        seed: seed of the scene.
    """

    num_steps: Annotated[int, Field(ge=1)] = 50
    num_uncontained_steps: Annotated[int, Field(ge=0)] = 0
    values: Mapping[str, MaterialValues] = field(default_factory=dict)
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Measurement:
    """A measured quantity: name of the ``metric``, ``value`` and ``unit``."""

    metric: str
    value: float
    unit: str


def start(simulator: LearnedSimulator, scene: SceneDistribution, settings: ShowcaseSettings) -> tuple[State, Metadata]:
    """Return the initial state of the scene and its metadata. All velocities of the history equal the initial velocity.

    Raises:
        SceneError: the scene does not fit the simulator.
        ValueError: there is no such scene, it lacks a material in ``settings.values``, or a value is outside the limits of the solvers.
    """
    metadata = replace(describe(scene, simulator.builder.metadata.frame_dt, seed=settings.seed), dataset="showcase")
    unknown = settings.values.keys() - set(metadata.materials)
    if unknown:
        raise ValueError(f"values.{min(unknown)}: no material of this scene, which has {', '.join(metadata.materials)}")
    for material, values in settings.values.items():
        try:
            named = parameters_by_name(material, values)
        except ValueError as error:
            raise ValueError(f"values.{material}: {error}") from None
        for parameter in MATERIALS[material]:
            if parameter.name in named and (fault := limits_fault(parameter, named[parameter.name])):
                raise ValueError(f"values.{material}: {fault}")
    start_state = scene.sample(settings.values, settings.seed)
    metadata = replace(metadata, param_names=start_state.param_names)
    state = simulator.standing(start_state, metadata)
    impossible = unsound(state, metadata)
    if impossible is not None:
        raise ValueError(f"values: {impossible.message}")
    return state, metadata


def run(
    simulator: LearnedSimulator,
    state: State,
    metadata: Metadata,
    settings: ShowcaseSettings,
    folder: Path,
    on_progress: Callable[[int, int], Any] | None = None,
) -> list[Measurement]:
    """Roll the simulator out from a ``start``; writes ``showcase.json``, ``.md``, ``.png`` and ``.gif`` (``.mp4`` if ``imageio_ffmpeg`` is installed).

    Args:
        simulator: trained simulator for the scene's spacing and materials.
        state, metadata: result of ``start``.
        settings: length of the rollouts.
        folder: folder for the files.
        on_progress: called with the number of frames done and their total.

    Returns:
        Numbers of nodes, boundary nodes and steps done with and without containment; median time per step [s] and peak memory of the process [B]; largest
        speed [m/s]; and these fractions:

        - ``fraction_corrected``: particle-steps that containment corrected.
        - ``fraction_too_fast``: particle-steps faster than ``MAX_SPEED_FACTOR`` times the speed after a free fall through the domain.
        - ``fraction_outside_at_end``: particles in a wall at the end.
        - ``fraction_outside_uncontained``: particle-frames in a wall without containment, from the same start.
        - ``fraction_asleep``: particle-steps that approximate skipping did not compute; with it, ``lost_impulse`` is the momentum that it lost [kg m/s].
    """
    folder.mkdir(parents=True, exist_ok=True)
    runner, total = approximate(simulator), settings.num_steps + settings.num_uncontained_steps
    film, tally, stop, outside = _Film(state, metadata, settings.num_steps), _Tally(state, metadata), None, []
    for frame, item in _frames(Contained(runner, metadata.frame_dt), state, settings.num_steps, metadata):
        if isinstance(item, Termination):
            stop = item.message
            break
        tally.add(item)
        film.add(frame, item)
        if on_progress is not None:
            on_progress(frame, total)
        tally.resume()
    for frame, item in _frames(runner, state, settings.num_uncontained_steps, metadata):
        outside.append(1.0 if isinstance(item, Termination) else _fraction_deeper(item, DEPTH * metadata.spacing))
        if on_progress is not None:
            on_progress(settings.num_steps + frame, total)
    records = tally.records()
    if runner is not simulator:
        records += tally.skipped()
    if outside:
        records.append(Measurement("num_uncontained_steps", float(len(outside)), "1"))
        records.append(Measurement("fraction_outside_uncontained", float(np.mean(outside)), "1"))
    finite = [vars(r) | {"value": r.value if math.isfinite(r.value) else None} for r in records]  # nan after no step; JSON has none
    written = {"environment": environment(), "records": finite, "stopped": stop}
    replace_text(folder / "showcase.json", json.dumps(written, indent=1, allow_nan=False))
    replace_text(folder / "showcase.md", table(records, stop))
    film.write(folder / "showcase")
    return records


class _Tally:
    """Counts the events and times of a rollout."""

    def __init__(self, state: State, metadata: Metadata) -> None:
        self.end, self.limit = state, MAX_SPEED_FACTOR * _fall_speed(state, metadata)
        self.num_corrected, self.num_too_fast, self.top_speed = 0.0, 0, 0.0
        self.num_asleep, self.lost_impulse = 0.0, 0.0
        self.seconds: list[float] = []
        self.resume()

    def resume(self) -> None:
        """Start the clock of the next step."""
        self.started = time.perf_counter()

    def add(self, state: State) -> None:
        """Stop the clock, and count the step's new state."""
        self.seconds.append(time.perf_counter() - self.started)
        speed = state.vel.norm(dim=1)
        self.end, self.top_speed = state, max(self.top_speed, float(speed.max()))
        self.num_corrected += state.num_corrected
        self.num_asleep += state.num_asleep
        self.lost_impulse += state.lost_impulse
        self.num_too_fast += int((speed > self.limit).sum())

    def skipped(self) -> list[Measurement]:
        particle_steps = len(self.seconds) * self.end.num_nodes or math.nan
        return [
            Measurement("fraction_asleep", self.num_asleep / particle_steps, "1"),
            Measurement("lost_impulse", self.lost_impulse, "kg m/s"),
        ]

    def records(self) -> list[Measurement]:
        num_steps, size = len(self.seconds), self.end.num_nodes
        particle_steps = num_steps * size if num_steps else math.nan
        found: dict[str, tuple[float, str]] = {
            "num_nodes": (size, "1"),
            "num_boundary_nodes": (len(self.end.boundary.pos), "1"),
            "num_steps": (num_steps, "1"),
            "seconds_per_step": (float(np.median(self.seconds)) if num_steps else math.nan, "s"),
            "peak_memory": (peak_resident(), "B"),
            "fraction_corrected": (self.num_corrected / particle_steps, "1"),
            "fraction_too_fast": (self.num_too_fast / particle_steps, "1"),
            "fraction_outside_at_end": (_fraction_deeper(self.end, surface_tolerance(self.end.boundary.shapes)), "1"),
            "max_speed": (self.top_speed, "m/s"),
        }
        return [Measurement(metric, float(value), unit) for metric, (value, unit) in found.items()]


def _frames(simulator: Simulator, state: State, num_steps: int, metadata: Metadata) -> Any:
    """Yield frame number and new state of one scene, or a ``Termination`` if a node is not finite or far outside the domain."""
    guard = Guard(bounds=metadata.bounds, margin=max(high - low for low, high in metadata.bounds))
    for _, frame, item in frames(simulator, [Start(state, num_steps, metadata, guard)]):
        yield frame, item


def _fall_speed(state: State, metadata: Metadata) -> float:
    """Return the speed of the fastest node after a free fall through the domain [m/s]."""
    height = sum((high - low) * abs(g) for (low, high), g in zip(metadata.bounds, metadata.gravity, strict=True))
    return math.sqrt(2 * height + float(state.vel.norm(dim=1).max()) ** 2)


def _fraction_deeper(state: State, depth: float) -> float:
    """Return the fraction of nodes deeper than ``depth`` [m] inside a solid."""
    distance = signed_distance(state.boundary.shapes, state.pos)
    return float(cast(Any, distance < -depth).double().mean())


class _Film:
    """Keeps evenly spaced frames of a rollout in single precision, and draws them."""

    def __init__(self, state: State, metadata: Metadata, num_steps: int) -> None:
        self.state, self.stride = state, max(1, -(-num_steps // MAX_PICTURES))
        self.metadata = replace(metadata, frame_dt=self.stride * metadata.frame_dt)
        self.pos: list[np.ndarray] = []
        self.add(0, state)

    def add(self, frame: int, state: State) -> None:
        if frame % self.stride == 0:
            self.pos.append(state.pos.cpu().numpy().astype(np.float32))

    def write(self, stem: Path) -> None:
        from gpe_pl.viz.coloring import Coloring
        from gpe_pl.viz.film_strip import evenly_spaced_frames, film_strip
        from gpe_pl.viz.video import write_film

        trajectory = Trajectory(
            self.metadata,
            pos := np.stack(self.pos),
            np.broadcast_to(np.float32(0), pos.shape),  # not shown
            self.state.node_type.cpu().numpy(),
            self.state.mass.cpu().numpy(),
            self.state.material_params.cpu().numpy(),
            self.state.boundary.to_numpy(),
            is_prediction=True,
        )
        columns = evenly_spaced_frames(trajectory.num_frames, 4)
        strip = film_strip([("", trajectory)], columns, Coloring("height", [trajectory], columns))
        save_figure(strip, stem.with_suffix(".png"), dpi=220)
        extension = ".mp4" if find_spec("imageio_ffmpeg") else ".gif"
        write_film(stem.with_suffix(extension), "prediction", trajectory, fps=min(25.0, 1 / self.metadata.frame_dt))


def table(records: list[Measurement], stopped: str | None) -> str:
    """Return a table in Markdown with one row per record, and the reason if the rollout stopped early."""
    lines = [
        "| | value | unit |",
        "|---|---|---|",
        *(f"| {r.metric.replace('_', ' ')} | {r.value:.6g} | {'' if r.unit == '1' else r.unit} |" for r in records),
    ]
    return "\n".join([*lines, *(["", f"Stopped: {stopped}"] if stopped else []), ""])


def summary(records: list[Measurement]) -> str:
    """Return plain text with one line per record."""
    return "\n".join(f"showcase  {r.metric:28} {r.value:12.6g} {'' if r.unit == '1' else r.unit}".rstrip() for r in records)

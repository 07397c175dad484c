"""Benchmark of the ground-truth solvers: particle-substeps per second and core, time per frame, and trajectories per minute of whole data sets."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from gpe_pl.data.ground_truth import DatasetSpec, initial_state, trajectory_metadata
from gpe_pl.errors import GpeError
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.store import array_bytes, write_shard


class BenchmarkError(GpeError):
    """Raised when a case cannot be timed; the message names it."""


@dataclass(frozen=True)
class Case:
    """A data set to time.

    Attributes:
        overrides: overrides of ``python -m gpe_pl.simulate``.
        prototype: figures of an earlier implementation as text, printed beside the measured ones.
    """

    overrides: list[str]
    prototype: str = ""


@dataclass(frozen=True)
class Settings:
    """Settings of the benchmark.

    Attributes:
        cases: data sets, by label.
        num_trajectories: trajectories per case, at evenly spaced training indices.
        num_frames: number of frames of each, from the start.
        num_workers: number of processes that simulate at the same time, one core each.
    """

    cases: Annotated[dict[str, Case], Field(min_length=1)]
    num_trajectories: Annotated[int, Field(ge=1)] = 4
    num_frames: Annotated[int, Field(ge=2)] = 200
    num_workers: Annotated[int, Field(ge=1)] = 2


@dataclass(frozen=True)
class Timing:
    """Time and size of one simulated trajectory.

    Attributes:
        seconds: time of the simulation; kernels are compiled beforehand.
        num_frames, num_nodes, num_substeps: numbers of simulated frames, nodes and substeps.
        num_bytes, num_stored_bytes: sizes of its arrays in memory and in a shard.
    """

    seconds: float
    num_frames: int
    num_nodes: int
    num_substeps: int
    num_bytes: int
    num_stored_bytes: int


def simulate(spec: DatasetSpec, index: int, num_frames: int) -> Timing:
    """Simulate the first frames of a training trajectory, and store them to measure their size.

    Raises:
        BenchmarkError: the solver stopped early.
    """
    state, metadata = initial_state(spec, "train", index), trajectory_metadata(spec, "train", index)
    rollout(spec.label_solver, state, 1, metadata)  # loads the kernels before timing
    substeps: list[int] = []
    started = time.perf_counter()
    trajectory = rollout(spec.label_solver, state, num_frames, metadata, on_frame=lambda _, frame: substeps.append(frame.num_substeps))
    seconds = time.perf_counter() - started
    if trajectory.termination is not None:
        raise BenchmarkError(f"{spec.name}, training scene {index}: {trajectory.termination.message}")
    with tempfile.TemporaryDirectory() as folder:
        write_shard(Path(folder) / "shard.h5", [trajectory])
        stored = (Path(folder) / "shard.h5").stat().st_size
    return Timing(seconds, num_frames, state.num_nodes, sum(substeps), array_bytes(trajectory), stored)


def run(settings: Settings, specs: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """Return records per case, and a Markdown table."""
    records: list[dict[str, Any]] = []
    lines = []
    with ProcessPoolExecutor(settings.num_workers, multiprocessing.get_context("spawn")) as pool:
        for label, spec in specs.items():
            spec.label_solver.compile_kernels()
            frames = min(settings.num_frames, spec.num_frames - 1)
            indices = np.linspace(0, spec.num_train - 1, settings.num_trajectories).round().astype(int).tolist()
            timings = list(pool.map(simulate, [spec] * len(indices), indices, [frames] * len(indices)))
            seconds = sum(t.seconds for t in timings)
            per_frame = seconds / sum(t.num_frames for t in timings)
            measured = {
                "node_substeps_per_second": (sum(t.num_nodes * t.num_substeps for t in timings) / seconds, "1/s"),
                "substeps_per_frame": (sum(t.num_substeps for t in timings) / sum(t.num_frames for t in timings), "1"),
                "seconds_per_frame": (per_frame, "s"),
                "trajectories_per_minute": (60 * settings.num_workers / (per_frame * (spec.num_frames - 1)), "1/min"),
                "hours_per_2600_trajectories": (2600 * per_frame * (spec.num_frames - 1) / settings.num_workers / 3600, "h"),
                "bytes_per_trajectory": (sum(t.num_stored_bytes for t in timings) / len(timings) / (frames + 1) * spec.num_frames, "B"),
                "compression_ratio": (sum(t.num_bytes for t in timings) / sum(t.num_stored_bytes for t in timings), "1"),
            }
            records += [{"metric": metric, "case": label, "value": value, "unit": unit} for metric, (value, unit) in measured.items()]
            values = {metric: value for metric, (value, _) in measured.items()}
            nodes = round(sum(t.num_nodes for t in timings) / len(timings))
            lines.append(
                f"| {label} | {nodes} | {values['substeps_per_frame']:.1f} | {values['node_substeps_per_second'] / 1e6:.2f} | {1e3 * per_frame:.2f} | "
                f"{values['trajectories_per_minute']:.1f} | {values['hours_per_2600_trajectories']:.2f} | "
                f"{values['bytes_per_trajectory'] / 1e6:.1f} | {values['compression_ratio']:.2f} | {settings.cases[label].prototype} |"
            )
    table = "\n".join(
        [
            f"{settings.num_trajectories} training scenes per case at evenly spread parameter values, their first {settings.num_frames} frames, "
            f"from which those of whole trajectories follow; {settings.num_workers} processes at the same time, a core each. Compression: bytes in memory "
            "over bytes on disk. Prototype: figures of an earlier, minimal implementation on another machine; substeps per second and ms per frame on one "
            "core, trajectories per minute on two.",
            "",
            "| case | nodes | substeps per frame | 10⁶ node-substeps per second and core | ms per frame | trajectories per minute | "
            "hours for 2,600 trajectories | MB per trajectory | compression | prototype |",
            "|---|---|---|---|---|---|---|---|---|---|",
            *lines,
        ]
    )
    return records, table

"""Report of an import: facts, assumptions, repairs and refusals. It is printed, and written into the data's folder as JSON and Markdown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gpe_pl.errors.printable import printable
from gpe_pl.files.atomic import replace_text
from gpe_pl.schema import MATERIALS

REPORT_FILE = "report.json"
PAGE_FILE = "report.md"
MAX_LISTED = 20
"""Maximum number of warnings, repairs or refusals that are printed. The JSON file has all of them."""


@dataclass(frozen=True)
class Event:
    """A statement about one trajectory of a split: what was repaired, refused or looks wrong. ``frame`` is -1 if it concerns no particular frame."""

    split: str
    trajectory: str
    frame: int
    what: str

    def __str__(self) -> str:
        place = f"{self.split}, {self.trajectory}" + (f", frame {self.frame}" if self.frame >= 0 else "")
        return printable(f"{place}: {self.what}")


@dataclass
class SplitCounts:
    """Number of ``trajectories`` of a split, and the ranges ``[fewest, most]`` of their ``frames``, ``nodes`` and ``boundary_nodes``."""

    trajectories: int = 0
    frames: list[int] = field(default_factory=lambda: [0, 0])
    nodes: list[int] = field(default_factory=lambda: [0, 0])
    boundary_nodes: list[int] = field(default_factory=lambda: [0, 0])

    def add(self, frames: int, nodes: int, boundary_nodes: int) -> None:
        """Add a trajectory to the counts."""
        for name, value in (("frames", frames), ("nodes", nodes), ("boundary_nodes", boundary_nodes)):
            low, high = getattr(self, name) if self.trajectories else (value, value)
            setattr(self, name, [min(low, value), max(high, value)])
        self.trajectories += 1


@dataclass
class Report:
    """The result of an import; lengths in m, times in s. Without training trajectories, the first split takes their place.

    Attributes:
        name: name of the data set.
        format, source: format and path of the source.
        folder: folder of the data set.
        dim: space dimension.
        frame_dt, periodic, spacing, connectivity_radius: stored values.
        bounds: lowest and highest bound per axis over all trajectories [m].
        gravity: smallest and largest value per axis over all trajectories [m/s²].
        materials: by material, its number of ``nodes``, and ``parameters``, the smallest and largest value of each by name.
        splits: counts by split.
        neighbours: number of dynamic neighbours of a dynamic node within the radius (``mean``, ``min``, ``max``), and mean number of ``boundary``
            neighbours; in some frames of the first ``assemble.NUM_SAMPLED`` training trajectories.
        velocity_std, acceleration_std: rms per component in the train split [m/s, m/s²], the latter without gravity.
        max_speed, mean_acceleration: largest speed [m/s], and mean acceleration with gravity per axis [m/s²], of the first ``assemble.NUM_SAMPLED`` training
            trajectories. In free fall the acceleration is gravity.
        free_groups: number of groups of nodes in free flight, over the examined frames.
        disturbed_groups: number of these groups that do not accelerate with gravity.
        free_acceleration: median acceleration of these groups per axis [m/s²]; empty if there are none.
        step_in_spacings: displacement in one frame at ``max_speed``, in spacings.
        notes: assumptions and omissions that concern the whole data set.
        warnings: what looks wrong, and what to do. Warnings about the whole data set come first, then those by trajectory.
        origin: origin of stored positions in the source's coordinates [m].
        repairs, refusals: repairs and refusals by trajectory.
    """

    name: str
    format: str
    source: str
    folder: str
    dim: int = 0
    frame_dt: float = 0.0
    bounds: list[list[float]] = field(default_factory=list)
    periodic: list[bool] = field(default_factory=list)
    gravity: list[list[float]] = field(default_factory=list)
    spacing: float = 0.0
    connectivity_radius: float = 0.0
    materials: dict[str, dict[str, Any]] = field(default_factory=dict)
    splits: dict[str, SplitCounts] = field(default_factory=dict)
    neighbours: dict[str, float] = field(default_factory=dict)
    max_speed: float = 0.0
    velocity_std: float = 0.0
    acceleration_std: float = 0.0
    mean_acceleration: list[float] = field(default_factory=list)
    free_groups: int = 0
    disturbed_groups: int = 0
    free_acceleration: list[float] = field(default_factory=list)
    step_in_spacings: float = 0.0
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    origin: list[float] = field(default_factory=list)
    repairs: list[Event] = field(default_factory=list)
    refusals: list[Event] = field(default_factory=list)

    def write(self, folder: Path) -> None:
        """Write the report as JSON and as Markdown into a folder, each file atomically."""
        for name, text in ((REPORT_FILE, json.dumps(asdict(self), indent=1) + "\n"), (PAGE_FILE, self.markdown())):
            replace_text(folder / name, text)

    def text(self) -> str:
        """Format the report as the command prints it."""
        lines = [f"{self.name}: {self.format} data of {printable(self.source)}"]
        lines += [f"  {key:<14}{value}" for key, value in self._facts()]
        for title, items in self._lists():
            if items:
                lines.append(f"{title}:")
                lines += [f"  - {item}" for item in items]
        return "\n".join(lines)

    def markdown(self) -> str:
        """Format the report as the Markdown page in the data's folder."""
        lines = [f"# {self.name}", "", f"Imported from `{printable(self.source)}` ({self.format}).", "", "| | |", "|---|---|"]
        lines += [f"| {key} | {value.replace('|', '/')} |" for key, value in self._facts()]
        for title, items in self._lists():
            lines += ["", f"## {title}", ""]
            lines += [f"- {item}" for item in items] if items else ["None."]
        return "\n".join(lines) + "\n"

    def _facts(self) -> list[tuple[str, str]]:
        """Return the main facts as pairs of name and text."""
        axes = "xyz"[: self.dim]
        box = ", ".join(
            f"{axis} {low:.6g} … {high:.6g}{' periodic' if repeats else ''}"
            for axis, (low, high), repeats in zip(axes, self.bounds, self.periodic, strict=True)
        )
        free = ", ".join(f"{a:.3g}" for a in self.free_acceleration)
        groups = f"{self.free_groups} groups in free flight accelerate by ({free}) m/s², {self.disturbed_groups} of them not with gravity"
        measured = f"; {groups}" if self.free_groups else ""
        rows = [
            ("frame dt", f"{self.frame_dt:.6g} s"),
            ("bounds", f"{box} m"),
            ("gravity", f"({', '.join(map(_span, self.gravity))}) m/s²{measured}"),
            ("spacing", f"{self.spacing:.4g} m"),
            ("radius", f"{self.connectivity_radius:.4g} m = {self.connectivity_radius / self.spacing:.3g} spacings"),
        ]
        n = self.neighbours
        if n:
            rows.append(
                (
                    "neighbours",
                    f"{n['mean']:.1f} within the radius ({n['min']:.0f} … {n['max']:.0f}), and {n['boundary']:.1f} boundary nodes",
                )
            )
        for material, values in self.materials.items():
            spans = values["parameters"]
            own = [f"{p.name} {p.quantity(_span([*spans[p.name]]))}" for p in MATERIALS[material] if p.name in spans]
            rows.append((material, f"{values['nodes']} nodes in all trajectories, {', '.join(own)}"))
        for split, counts in self.splits.items():
            boundary = f", {_span(counts.boundary_nodes)} boundary nodes" if counts.boundary_nodes[1] else ""
            rows.append(
                (split, f"{counts.trajectories} trajectories, {_span(counts.frames)} frames, {_span(counts.nodes)} nodes{boundary}")
            )
        mean = ", ".join(f"{a:.3g}" for a in self.mean_acceleration)
        rows += [
            (
                "speed",
                f"{self.velocity_std:.4g} m/s rms, {self.max_speed:.4g} m/s at most in the first trajectories: {self.step_in_spacings:.2g} spacings per frame",
            ),
            ("acceleration", f"{self.acceleration_std:.4g} m/s² rms without gravity; mean with it ({mean}) m/s²"),
        ]
        return rows

    def _lists(self) -> list[tuple[str, list[str]]]:
        def first(events: Sequence[Event | str]) -> list[str]:
            more = len(events) - MAX_LISTED
            return [printable(str(e)) for e in events[:MAX_LISTED]] + ([f"… and {more} more in {REPORT_FILE}"] if more > 0 else [])

        return [
            ("Warnings", first(self.warnings)),
            ("Assumed or left out", [printable(text) for text in self.notes]),
            ("Repaired", first(self.repairs)),
            ("Refused", first(self.refusals)),
        ]


def _span(values: list[Any]) -> str:
    low, high = min(values), max(values)
    return f"{low:.6g}" if low == high else f"{low:.6g} … {high:.6g}"

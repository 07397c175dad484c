"""Validation of stored trajectories, and the page that describes their format.

    python -m gpe_pl.data.validate PATH [PATH ...]     shards, or folders of shards; exit status 1 if any rule is violated
    python -m gpe_pl.data.validate --format-page       Markdown, kept in data/README.md

The reader in ``gpe_pl.trajectory.store`` refuses data that it cannot read. This module also checks the meaning: units, ranges and completeness. Each check
reports the first violation with frame and node, and the number of further ones.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import h5py
import numpy as np

from gpe_pl.data import finer_labels_metadata
from gpe_pl.data.free_flight import FreeFlight, free_flights, joined, vector
from gpe_pl.data.position_rounding import motion_of, rounding_fault
from gpe_pl.errors.printable import printable, speak_utf8
from gpe_pl.files.hdf5_arrays import attribute, is_named
from gpe_pl.files.json_text import parsed
from gpe_pl.geometry.shape_values import shapes_fault
from gpe_pl.geometry.shapes import Shape
from gpe_pl.schema import BOUNDARY, FIELDS, MATERIALS, MOTION, NODE_TYPES, SCHEMA_VERSION, SPLITS, ParameterGroup
from gpe_pl.trajectory.openings import openings_fault
from gpe_pl.trajectory.store import (
    StoreError,
    digest,
    digested_attributes,
    metadata_of,
    node_types_of,
    open_group,
    open_shard,
    openings_of,
    read_field,
    read_text,
    shapes_of,
)
from gpe_pl.trajectory.trajectory import Metadata
from gpe_pl.trajectory.values import faults, size_conflicts

Finding = tuple[str, str]
"""Name of the field or attribute, and what is wrong with it."""

SAME_IN_A_DATASET = ("dataset", "materials", "param_names", "frame_dt", "spacing", "connectivity_radius", "dim")
"""Metadata that must be equal in all trajectories of a data set."""


@dataclass(frozen=True)
class Violation:
    """A violated rule.

    Attributes:
        path: shard, or folder without shards.
        trajectory: name of the trajectory in the shard; empty if the violation concerns the whole shard or folder.
        field: field or attribute; empty if the violation concerns several, or if the message names it.
        message: what is wrong.
    """

    path: Path
    trajectory: str
    field: str
    message: str

    def __str__(self) -> str:
        parts = (str(self.path), self.trajectory, self.field, self.message)
        return printable(": ".join(part for part in parts if part))


@dataclass
class Group:
    """Summary of the valid trajectories of one data set and split.

    Attributes:
        metadata: metadata of the first trajectory.
        frames, nodes: numbers of frames and of nodes of each trajectory.
        max_speed: largest speed [m/s].
        low, high: smallest and largest positions [dim] in m.
        params: values of each material parameter that occur.
        flights: groups in free flight of each trajectory.
        squared_accelerations: mean square acceleration without gravity [m²/s⁴] of each trajectory, and the number of its values.
        rounding: largest rounding error of accelerations [m/s²], and how positions are rounded there.
    """

    metadata: Metadata
    frames: list[int] = field(default_factory=list)
    nodes: list[int] = field(default_factory=list)
    max_speed: float = 0.0
    low: np.ndarray = field(default_factory=lambda: np.array(math.inf))
    high: np.ndarray = field(default_factory=lambda: np.array(-math.inf))
    params: dict[str, set[float]] = field(default_factory=dict)
    flights: list[FreeFlight] = field(default_factory=list)
    squared_accelerations: list[tuple[float, int]] = field(default_factory=list)
    rounding: tuple[float, str] = (0.0, "in float32")

    def add(self, metadata: Metadata, arrays: dict[str, np.ndarray]) -> None:
        """Add a trajectory to the summary."""
        pos, vel = arrays["pos"], arrays["vel"].astype(np.float64)
        self.frames.append(pos.shape[0])
        self.nodes.append(pos.shape[1])
        self.max_speed = max(self.max_speed, float(np.sqrt((vel**2).sum(-1)).max()))
        self.low, self.high = np.minimum(self.low, pos.min((0, 1))), np.maximum(self.high, pos.max((0, 1)))
        for name, column in zip(metadata.param_names, arrays["material_params"].T, strict=True):
            self.params.setdefault(name, set()).update(np.unique(column[~np.isnan(column)]).tolist())
        if "alive" in arrays:  # nodes enter with a prescribed velocity, so accelerations and free groups say nothing about the solver
            self.flights.append(joined([], metadata.dim))
            return
        self.flights.append(joined(free_flights(metadata, arrays), metadata.dim))
        if len(pos) > 2:
            motion = motion_of(metadata, pos)
            self.squared_accelerations.append((motion.acceleration**2, pos[2:].size))
            stored, given = motion.rounding(np.float32, np.zeros(metadata.dim)), motion.rounding_to_marks
            self.rounding = max(
                self.rounding, (float(stored.max()), "in float32"), (float(given.max()), f"in steps of {motion.marks.max():.3g} m")
            )

    def __str__(self) -> str:
        m = self.metadata

        def span(values: Iterable[float] | Iterable[int]) -> str:
            low, high = min(values), max(values)
            return f"{low:.6g}" if low == high else f"{low:.6g} … {high:.6g}"

        box = " × ".join(f"{a:.4g} … {b:.4g}" for a, b in zip(self.low, self.high, strict=True))
        lines = [
            printable(f"{m.dataset}/{m.split}: {len(self.frames)} trajectories of {'+'.join(m.materials)} in {m.dim}D"),
            f"  frames {span(self.frames)}, nodes {span(self.nodes)}, frame_dt {m.frame_dt:.6g} s, solver_dt {m.solver_dt:.6g} s",
            f"  spacing {m.spacing:.6g} m, connectivity_radius {m.connectivity_radius:.6g} m",
            f"  positions {box} m, fastest {self.max_speed:.4g} m/s",
        ]
        lines += [f"  {name}: {len(values)} values, {span(values)}" for name, values in self.params.items() if values]
        lines += [f"  {line}" for line in (*self._about_rounding(), *self._about_free_flight())]
        return "\n".join(lines)

    @property
    def flight(self) -> FreeFlight:
        """Free groups of all trajectories."""
        return joined(self.flights, self.metadata.dim)

    def _about_rounding(self) -> Iterator[str]:
        squares, counts = zip(*self.squared_accelerations, strict=True) if self.squared_accelerations else ((0.0,), (1,))
        error, where = self.rounding
        if fault := rounding_fault(error, math.sqrt(np.average(squares, weights=counts)), where):
            yield f"{fault}: a model would learn noise; a longer frame_dt is needed, or positions nearer to 0 or with more digits"

    def _about_free_flight(self) -> Iterator[str]:
        flight = self.flight
        if flight.num_free:
            disturbed, free, islands = flight.num_disturbed, flight.num_free, flight.num_islands
            advice = "above 0.1 % choose a larger connectivity_radius, unless positions are measured or air resists"
            if finer_labels_metadata.factor_of(self.metadata) != 1:
                advice = "tracers of a finer solver are also moved by parts of particles that are not stored"
            yield f"free groups accelerate by {vector(flight.typical)} (median), gravity is {vector(np.median(flight.gravity, axis=0))}"
            yield (
                f"{disturbed} of {free} free groups do not accelerate with gravity "
                f"({disturbed / free:.3%} of the free groups, {disturbed / islands:.3%} of all {islands} groups in the examined frames); "
                + (
                    "they agree on another acceleration: gravity, frame_dt or the unit of length does not fit the data"
                    if flight.agrees_on_another
                    else advice
                )
            )
        elif flight.num_islands:
            yield f"none of {flight.num_islands} groups in the examined frames is free: the connectivity radius was not tested against the solver"


@dataclass
class Result:
    """Result of a validation: ``violations``, and summaries (``groups``) of the trajectories without violations, by data set and split."""

    violations: list[Violation] = field(default_factory=list)
    groups: dict[tuple[str, str], Group] = field(default_factory=dict)


def validate(paths: Iterable[Path | str]) -> Result:
    """Check shards and folders of shards. Faults are returned as violations; no content of a file raises an error."""
    result = Result()
    seen: dict[str, str] = {}  # digest -> place of its first trajectory
    reference: dict[str, tuple[str, Metadata]] = {}  # data set -> place and metadata of its first trajectory
    for path in map(Path, paths):
        files = sorted(path.rglob("*.h5")) if path.is_dir() else [path]
        if not files:
            result.violations.append(Violation(path, "", "", "no shards (*.h5) in this folder; generate or import data"))
        for file in files:
            _check_file(file, result, seen, reference)
    return result


def _check_file(path: Path, result: Result, seen: dict[str, str], reference: dict[str, tuple[str, Metadata]]) -> None:
    def violation(trajectory: str, field: str, message: str) -> None:
        # Messages of the reader begin with file and trajectory, which the violation already names.
        for prefix in (f"{path}:{trajectory}: ", f"{path}: "):
            message = message.removeprefix(prefix)
        result.violations.append(Violation(path, trajectory, field, message))

    try:
        with open_shard(path) as file:
            for key, message in _check_shard(file):
                violation("", key, message)
            for name in sorted(file):
                before = len(result.violations)
                try:
                    metadata, arrays, sha, findings = _check_trajectory(open_group(file, name), path)
                except StoreError as error:
                    violation(name, "", str(error))
                    continue
                for key, message in findings:
                    violation(name, key, message)
                where = f"{path}:{name}"
                if seen.setdefault(sha, where) != where:
                    violation(name, "", f"has exactly the content of {seen[sha]}: the same scene twice")
                first, common = reference.setdefault(metadata.dataset, (where, metadata))
                for key in SAME_IN_A_DATASET:
                    if getattr(metadata, key) != getattr(common, key):
                        violation(name, key, f"is {getattr(metadata, key)}, but {getattr(common, key)} in {first} of the same data set")
                own, others = map(finer_labels_metadata.factor_of, (metadata, common))
                if own != others:
                    violation(name, "config", f"fine is {own}, but {others} in {first} of the same data set")
                if len(result.violations) == before:
                    group = result.groups.setdefault((metadata.dataset, metadata.split), Group(metadata))
                    group.add(metadata, arrays)
    except StoreError as error:
        violation("", "", str(error))


def _check_shard(file: h5py.File) -> Iterator[Finding]:
    count = attribute(file, "num_trajectories")
    if not isinstance(count, np.integer) or count != len(file):
        yield "num_trajectories", f"is {count}, but the file holds {len(file)} trajectories"
    if len(file) == 0:
        yield "", "no trajectories"
    expected = {key: spec.unit for key, spec in FIELDS.items()}
    try:
        units = parsed(read_text(file, "units"))
    except StoreError as error:
        yield "units", str(error).split(": ", 1)[-1]
    except ValueError as error:
        yield "units", f"is not JSON: {error}"
    else:
        optional = {key for key, spec in FIELDS.items() if not spec.required}  # files from before an optional field was introduced lack it
        if not isinstance(units, dict) or {**expected, **units} != expected or not expected.keys() - optional <= units.keys():
            yield "units", "differ from those of the schema; the store is in SI units"


def _check_trajectory(group: h5py.Group, path: Path) -> tuple[Metadata, dict[str, np.ndarray], str, list[Finding]]:
    """Check one trajectory, and return its metadata, readable arrays, digest and findings.

    Raises:
        StoreError: the metadata or another attribute cannot be read.
    """
    metadata = metadata_of(group)
    findings = list(_check_metadata(metadata, path))
    arrays: dict[str, np.ndarray] = {}
    for key, spec in FIELDS.items():
        if spec.required or is_named(group, key):
            try:
                arrays[key] = read_field(group, key)
            except StoreError as error:
                findings.append(("", str(error)))
    findings += [(key, "is not a field of this schema") for key in group if key not in FIELDS]
    conflicts = size_conflicts(arrays, metadata.dim, len(metadata.param_names))
    findings += [("", conflict) for conflict in conflicts]
    sha = read_text(group, "sha256")
    if digest(arrays, digested_attributes(group)) != sha:
        findings.append(("sha256", "does not match the content; delete the shard and generate or import the data again"))
    complete = all(key in arrays for key, spec in FIELDS.items() if spec.required)
    if complete and not conflicts:  # the following checks need consistent shapes
        names = node_types_of(group)
        unsound = list(faults(arrays, names, [m for m in metadata.materials if m in MATERIALS], metadata.param_names))
        findings += [(fault.field, fault.message) for fault in unsound]
        wrong = {fault.field for fault in unsound}
        if "node_type" not in wrong:
            findings += _check_parameters(metadata, arrays, names)
        findings += _check_motion(metadata, arrays)
        findings += _check_shapes(metadata, arrays, shapes_of(group), "boundary_pos" not in wrong)
        if (fault := openings_fault(openings_of(group), metadata.dim, len(metadata.param_names), len(names))) is not None:
            findings.append(("openings", fault))
    return metadata, arrays, sha, findings


def _check_metadata(m: Metadata, path: Path) -> Iterator[Finding]:
    for key in ("dataset", "solver", "solver_version"):
        if not getattr(m, key):
            yield key, "is empty; it must say where the data come from"
    yield from m.violations()
    try:
        parsed(m.config)
    except ValueError:
        yield "config", "is not JSON"
    yield from (("config", fault) for fault in finer_labels_metadata.faults(m))
    if m.split not in SPLITS:
        yield "split", f"is {m.split!r}, must be one of {', '.join(SPLITS)}"
    folder = path.absolute().parent.name
    if folder in SPLITS and m.split != folder:
        yield "split", f"is {m.split!r}, but the shard lies in the folder {folder!r}"
    if m.parameter_group not in get_args(ParameterGroup):
        yield "parameter_group", f"is {m.parameter_group!r}, must be one of {', '.join(get_args(ParameterGroup))}"
    elif (m.split == "test_unseen") == (m.parameter_group == "seen"):
        yield "parameter_group", f"is {m.parameter_group!r} in split {m.split!r}: unseen values belong into test_unseen, and only there"


def _offenders(key: str, bad: np.ndarray) -> str | None:
    """Describe where a check fails: the first place, and the number of further places. None means that the check passes."""
    if not bad.any():
        return None
    place = np.argwhere(bad)[0]
    axes = [
        f"{'frame' if axis == MOTION else axis} {i}"
        for axis, i in zip(FIELDS[key].dims, place, strict=False)
        if not (axis == MOTION and bad.shape[0] == 1)
    ]
    more = int(bad.sum()) - 1
    return ", ".join(axes) + (f" and {more} more" if more else "")


def _check_parameters(m: Metadata, arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> Iterator[Finding]:
    by_code = [MATERIALS.get(name, ()) for name in names]
    for column, name in enumerate(m.param_names):
        used = np.isin(arrays["node_type"], [k for k, own in enumerate(by_code) if name in (p.name for p in own)])
        if where := _offenders("mass", ~used & ~np.isnan(arrays["material_params"][:, column])):
            yield "material_params", f"{name}: {where}: has a value, but the material has no such parameter (NaN expected)"


def _check_motion(m: Metadata, arrays: dict[str, np.ndarray]) -> Iterator[Finding]:
    pos = arrays["pos"]
    if pos.shape[0] < 2 or pos.shape[1] < 1:
        yield "pos", f"has {pos.shape[0]} frames and {pos.shape[1]} nodes; at least 2 frames and 1 node are needed"
        return
    yield from (("pos", text) for text in outside_bounds(m, pos))


def outside_bounds(m: Metadata, pos: np.ndarray) -> Iterator[str]:
    """Yield the first position [frame, node, dim] outside the bounds of the domain, for each axis that is not periodic."""
    for axis, (low, high) in enumerate(m.bounds):
        slack = 1e-5 * max(abs(low), abs(high), high - low)  # rounding to float32, and the margin of the solvers
        outside = (pos[..., axis] < low - slack) | (pos[..., axis] > high + slack)
        if m.periodic[axis : axis + 1] != (True,) and (where := _offenders("pos", outside)):
            yield f"{where}: {'xyz'[axis : axis + 1]} = {pos[..., axis][outside][0]:.6g} m is outside the bounds {low:g} … {high:g} m"


def _check_shapes(m: Metadata, arrays: dict[str, np.ndarray], shapes: tuple[Shape, ...], sound: bool) -> Iterator[Finding]:
    """Check the shapes of walls and obstacles. If positions are ``sound`` and not imported, also check that boundary nodes lie on the shapes."""
    pos = arrays["boundary_pos"]
    if (wrong := shapes_fault(shapes, m.periodicity)) is not None:
        yield "shapes", wrong
        return
    if shapes and sound and m.spacing > 0 and not m.solver.startswith("import/"):  # imported boundaries may have nodes without shapes
        distance = np.min([np.abs(shape.signed_distance(pos.astype(np.float64))) for shape in shapes], axis=0)
        if where := _offenders("boundary_pos", distance > 0.1 * m.spacing):
            yield "boundary_pos", f"{where}: {distance[distance > 0.1 * m.spacing][0]:.4g} m away from every shape that it could belong to"


# --- the page that describes the format ---------------------------------------------------------------------------------------------------


def format_page() -> str:
    """Create the Markdown page that describes the store, from the schema."""
    meaning = _documented_attributes(Metadata)
    rows = {
        "fields": [
            f"| `{key}` | {'×'.join(f.dims)} | {f.dtype} | {f.unit} | {f.values} | {f.doc}{'' if f.required else ' (optional)'} |"
            for key, f in FIELDS.items()
        ],
        "metadata": [f"| `{key}` | {meaning[key]} |" for key in Metadata.__dataclass_fields__],
        "materials": [
            f"| `{name}` | `{p.name}` | {p.unit} | {p.rule} | {p.limits} | {p.scale} | {'optional' if k else 'always'} |"
            for name, own in MATERIALS.items()
            for k, p in enumerate(own)
        ],
    }
    return _PAGE.format(
        version=SCHEMA_VERSION,
        splits=", ".join(f"`{s}`" for s in SPLITS),
        codes=", ".join(f"{k} = `{name}`" for k, name in enumerate(NODE_TYPES)),
        boundary=BOUNDARY,
        groups=", ".join(f"`{g}`" for g in get_args(ParameterGroup)),
        **{key: "\n".join(lines) for key, lines in rows.items()},
    )


def _documented_attributes(cls: type) -> dict[str, str]:
    """Return the attributes and their descriptions in a Google docstring."""
    section = inspect.cleandoc(cls.__doc__ or "").split("Attributes:\n", 1)[1]
    meaning: dict[str, str] = {}
    for names, text in re.findall(r"^    ([\w, ]+): (.*(?:\n        .*)*)", section, re.MULTILINE):
        meaning.update(dict.fromkeys(re.split(r",\s*", names), re.sub(r"\s+", " ", text).replace("``", "`").rstrip(".")))
    return meaning


_PAGE = """\
# The trajectory store

This page is generated: `python -m gpe_pl.data.validate --format-page > data/README.md`. Generated and imported data sets go into this folder and are not
kept in version control. Check them with `python -m gpe_pl.data.validate data`.

Schema version {version}. There is one HDF5 file per shard and one group per trajectory. Values are in SI units and little-endian:

```
{{data set}}/{{size}}/{{split}}/shard-00000.h5
    attributes: schema_version, units (JSON), num_trajectories
    00000/  00001/  …                      one trajectory each
        attributes: metadata (JSON), shapes (JSON), node_types (JSON), sha256; start_time (JSON, s) if the trajectory begins later than
                    its scene; openings (JSON) if the scene has inlets and outlets; termination (JSON) if it is a
                    rollout that stopped early; prediction if a model predicted it
        pos  vel  …                        fields, each with an attribute unit
```

Imported data sets have the size `imported`. Their folder also has a `report.md` about the source.

Files are written under a temporary name and then renamed, so an existing file is complete. Equal content gives equal bytes. Every array has a
fletcher32 checksum per chunk. Arrays with frames are chunked along the frames. `sha256` covers names, shapes, types and bytes of all arrays, and all
other attributes except `prediction`. Arrays are compressed without loss (shuffle and gzip, which every HDF5 library reads). Text has a fixed length. No file
refers to another file.

Splits: {splits}. In the first three, material parameters have the trained values. In the last one, some of them lie between or outside the trained values.
`parameter_group` ({groups}) is `extrapolated` if any parameter lies outside the trained range.

## Fields

| name | axes | type | unit | values | meaning |
|---|---|---|---|---|---|
{fields}

Values are finite and at most 1.8e19 in magnitude. The reader refuses other values, and names file, trajectory, field, frame and node.

`node_type` is an index into the attribute `node_types`: {codes}. It covers dynamic nodes only; `{boundary}` nodes have separate fields.

## Materials and their parameters

| material | column of `material_params` | unit | stored values are | the solvers accept | scale | stored |
|---|---|---|---|---|---|---|
{materials}

`param_names` lists the columns of a data set, in the order of this table. The first parameter of each material is always stored. A parameter that is not
stored has the value of the solver's settings. A name stands for one column: materials with the same parameter store it together.

## Metadata

| key | meaning |
|---|---|
{metadata}

`shapes` describes the geometry from which boundary nodes were sampled; `gpe_pl.geometry.shape_values` rebuilds it.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m gpe_pl.data.validate", description="Check stored trajectories.")
    parser.add_argument("paths", nargs="*", metavar="PATH", help="shard, or folder of shards")
    parser.add_argument("--format-page", action="store_true", help="print the description of the format as Markdown")
    options = parser.parse_args(arguments)
    speak_utf8()
    if options.format_page:
        print(format_page(), end="")
        return 0
    if not options.paths:
        parser.error("name at least one shard or folder")
    result = validate(options.paths)
    for violation in result.violations:
        print(violation)
    for group in result.groups.values():
        print(group)
    if result.violations:
        print(f"{len(result.violations)} violations")
    return 1 if result.violations else 0


if __name__ == "__main__":
    sys.exit(main())

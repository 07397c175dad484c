"""Conversion of a source to a stored data set: two passes over the source, checks across trajectories, statistics and the report."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.frame_velocities import ADVICE, are_means
from gpe_pl.data.free_flight import joined, vector
from gpe_pl.data.importers.given_values import without_effect
from gpe_pl.data.importers.report import Event, Report, SplitCounts
from gpe_pl.data.importers.sampled import about_walls, degrees_of, speed_and_acceleration
from gpe_pl.data.importers.source import Facts, ImportFailure, ImportSettings, Item, Loaded, Refusal, Source
from gpe_pl.data.importers.splits import arranged
from gpe_pl.data.importers.survey import NUM_SAMPLED, SPACING_RATIO, Survey
from gpe_pl.data.importers.trained_parameters import TrainedParameters, parameters_in
from gpe_pl.data.position_rounding import ROUNDING_FRACTION, MotionSummary, better_origin, rounding_fault
from gpe_pl.data.statistics import STATISTICS_FILE, combined, shard_moments
from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.files.atomic import free_bytes, replacing
from gpe_pl.files.names import NameRefused, data_name
from gpe_pl.geometry.periodicity import PeriodicityError
from gpe_pl.schema import HISTORY, LOADS, MATERIALS, SPLITS, ParameterGroup, node_code, param_names
from gpe_pl.system.locks import locked
from gpe_pl.system.progress import Progress
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.store import iter_trajectories, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

FOLDER = "imported"
"""Folder of imported data in the folder of a data set. Generated data have folders named by their size."""

CONTACT_SHEET_FILE = "contact_sheet.png"
VERSION = "1"
"""Version of the conversion, stored as ``solver_version``."""
TRAJECTORIES_PER_SHARD = 8
ENOUGH_GROUPS = 20
"""Number of groups in free flight, over all examined frames, from which the gravity of a source is measured if it does not state one."""
NUM_SHOWN = 4
"""Number of rows of the contact sheet."""

FEWEST_NEIGHBOURS, MOST_NEIGHBOURS = 3.0, 60.0
"""A warning is given for a mean number of neighbours outside this range."""
SHORT = 10 * HISTORY
"""With fewer frames, the report says how to use more of them."""
SAME_LENGTH, SAME_MEASURED = 1.1, 1.5
"""A warning is given if spacings or radii of trajectories differ by more than the first factor, or spacings that were measured by more than the second."""
VELOCITY_RATIO = 1.25
"""A warning is given if displacements and velocities of a source differ by more than this factor."""
TYPED = ("gns", "lagrangebench", "meshgraphnets", "calculix", "meshio")
"""Formats with node types."""


def import_dataset(root: Path | str, settings: ImportSettings, on_progress: Progress | None = None, contact_sheet: bool = False) -> Report:
    """Convert a source to the data set ``{root}/{name}/imported``.

    Args:
        root: folder of all data sets.
        settings: the source, and values that override it.
        on_progress: called for each trajectory that is read, with the number of reads so far and the total number of reads.
        contact_sheet: draw the contact sheet before the data set appears; see ``draw_contact_sheet``.

    Raises:
        ImportFailure: the source cannot be read, no trajectory of a split can be used, nothing accelerates other than by gravity, the disk is too small, or the
            data set exists already.
    """
    path = Path(settings.source).expanduser()
    name = settings.name or path.name.partition(".")[0]
    if not settings.name:
        try:
            data_name(name)
        except NameRefused as error:
            raise ImportFailure(f"{error}; pass name=…") from None
    folder = _free_folder(Path(root), name)
    if settings.materials and settings.format not in TYPED:
        raise ImportFailure(f"materials={settings.materials}: {settings.format} has no node types; {', '.join(TYPED)} have")
    if settings.arrays and settings.format != "meshio":
        raise ImportFailure(f"arrays={settings.arrays}: only format=meshio finds arrays by their names")
    module = importlib.import_module(f"gpe_pl.data.importers.{settings.format}")
    source = arranged(module.open_source(path, settings), settings)
    if settings.max_trajectories is not None:
        source = replace(source, splits={split: items[: settings.max_trajectories] for split, items in source.splits.items()})
    about = {
        "format": settings.format,
        "source": str(path.absolute()),
        "settings": {k: v for k, v in asdict(settings).items() if v is not None},
    }
    return _Conversion(name, folder, source, settings.holdout, about, on_progress).run(contact_sheet)


def save_dataset(root: Path | str, name: str, holdout: float = 0.1, **splits: Iterable[Trajectory]) -> Report:
    """Write your own trajectories to ``{root}/{name}/imported``. ``python -m gpe_pl.fit data=imported data.name={name}`` trains on them.

    Trajectories that cannot be used are left out. ``Report.refusals`` lists them.

    Args:
        root: folder of all data sets; ``data`` unless the command gets another ``paths.data``.
        name: name of the data set.
        holdout: fraction of ``train`` that becomes each of ``val`` and ``test`` if they are not given.
        splits: ``train=[…]``, ``val=[…]``, ``test=[…]`` and ``test_unseen=[…]``; see ``Trajectory.from_numpy``. Each trajectory is requested twice. A
            sequence that creates trajectories on request is never in memory as a whole. Other iterables are converted to lists first.

    Raises:
        ImportFailure: there is nothing to train on, no trajectory of a split can be used, an item is not a trajectory, the disk is too small, or the data set
            exists already.
    """
    for split, trajectories in splits.items():
        if isinstance(trajectories, Trajectory):
            raise ImportFailure(f"{split}: is one trajectory; give a list of them, {split}=[…]")
    given = {split: trajectories if isinstance(trajectories, Sequence) else list(trajectories) for split, trajectories in splits.items()}
    unknown = sorted(set(given) - {"train", "val", "test", "test_unseen"})
    if unknown or not given.get("train"):
        raise ImportFailure(
            f"splits: {unknown[0]} is none of train, val, test, test_unseen"
            if unknown
            else "train has no trajectories; a model learns from them"
        )
    items = {split: [_member(split, trajectories, k) for k in range(len(trajectories))] for split, trajectories in given.items()}
    about = {"format": "arrays", "source": "memory", "settings": {}}
    return _Conversion(name, _free_folder(Path(root), name), Source(Facts(), items), holdout, about).run()


def draw_contact_sheet(report: Report) -> Path:
    """Draw some scenes of an imported data set, and return the path of the picture."""
    return _draw_contact_sheet(Path(report.folder), next(iter(report.splits)))


def _draw_contact_sheet(folder: Path, split: str) -> Path:
    from gpe_pl.viz.captions import describe
    from gpe_pl.viz.contact_sheet import contact_sheet
    from gpe_pl.viz.saving import save_figure

    shown = list(islice(iter_trajectories(folder, split), NUM_SHOWN))
    values = [describe(trajectory) for trajectory in shown]
    differ = len(set(values)) > 1
    figure = contact_sheet(
        {f"{split} {k}{f': {text}' if differ else ''}": t for k, (t, text) in enumerate(zip(shown, values, strict=True))}
    )
    path = folder / CONTACT_SHEET_FILE
    save_figure(figure, path)
    return path


def _member(split: str, trajectories: Sequence[Trajectory], k: int) -> Item:
    def load(_: Facts) -> Loaded:
        item = trajectories[k]
        if not isinstance(item, Trajectory):
            raise ImportFailure(f"{split}[{k}]: is of type {type(item).__name__}; make a trajectory of arrays with Trajectory.from_numpy")
        return Loaded(item)

    return Item(f"{split}[{k}]", load)


def _free_folder(root: Path, name: str) -> Path:
    try:
        folder = root / data_name(name) / FOLDER
    except NameRefused as error:
        raise ImportFailure(str(error)) from None
    _check_free(folder)
    return folder


def _check_free(folder: Path) -> None:
    if folder.exists():
        raise ImportFailure(f"{folder}: exists already, and imported data are never overwritten; delete it, or choose another name=…")


class _Conversion:
    """The conversion of one data set."""

    def __init__(
        self, name: str, folder: Path, source: Source, holdout: float, about: dict[str, Any], on_progress: Progress | None = None
    ) -> None:
        # Training comes first, because shared facts are taken from it. If a scene is in two splits, the later one is refused.
        self.source = replace(source, splits={split: source.splits[split] for split in SPLITS if split in source.splits})
        self.facts, self.holdout, self.folder, self.about = source.facts, holdout, folder, about
        self.report = Report(name, about["format"], about["source"], str(folder), warnings=list(source.warnings))
        self.survey = Survey()
        self.trained = TrainedParameters()
        self.origin = np.zeros(0)
        self.on_progress, self.num_read = on_progress, 0

    def run(self, contact_sheet: bool = False) -> Report:
        """Run both passes; the folder appears with its complete content."""
        with locked(self.folder, "paths.data", makes=False):
            _check_free(self.folder)  # again, because another command may just have written it
            self._look()
            self._decide()
            self._require_room()
            with replacing(self.folder) as part:
                for split in SPLITS:  # train first, because it determines which parameters are unseen
                    if split in self.survey.good:
                        self._write(part, split, self.survey.good[split])
                self._summarize(part)
                self.report.warnings += [str(suspect) for suspect in self.survey.suspects]
                self.report.write(part)
                if contact_sheet:
                    _draw_contact_sheet(part, next(iter(self.report.splits)))
        return self.report

    def _require_room(self) -> None:
        free = free_bytes(self.folder)
        if self.survey.num_bytes > free:
            raise ImportFailure(
                f"{self.folder}: the data need up to {self.survey.num_bytes / 2**30:.3g} GiB, the disk has {free / 2**30:.3g} GiB free; "
                "choose another folder with paths.data"
            )

    # --- first pass ------------------------------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Read every trajectory once, refuse those that cannot be used, and collect facts about the others."""
        for split, items in self.source.splits.items():
            if not items:
                self.report.warnings.append(f"{split}: the source has this split, and no trajectory in it; is the source complete?")
            for item in items:
                try:
                    loaded = self._load(item)
                    self.survey.add(split, item, loaded, self.facts)
                except (Refusal, ArrayError) as refusal:
                    self.report.refusals.append(Event(split, item.name, refusal.frame, str(refusal)))
                    continue
                self.report.repairs += [Event(split, item.name, repair.frame, repair.what) for repair in loaded.repairs]
                self.report.notes += [note for note in loaded.notes if note not in self.report.notes]
        self.report.refusals += self.survey.refused_as_incomplete()
        self.report.notes = [*self.facts.notes, *self.report.notes]
        self.report.warnings += without_effect(self.about["settings"], self.survey.materials, self.survey.types)

    def _load(self, item: Item) -> Loaded:
        if self.on_progress is not None:
            self.num_read += 1
            self.on_progress(self.num_read, 2 * sum(map(len, self.source.splits.values())))
        try:
            return item.load(self.facts)
        except PeriodicityError as error:
            raise Refusal(f"{error} (connectivity_radius=…)") from None
        except GpeError:
            raise
        except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:  # unforeseen damage
            raise Refusal(f"cannot be read ({type(error).__name__}: {error})") from error

    def _decide(self) -> None:
        """Choose values that the source does not state, and splits that it does not have."""
        survey, report = self.survey, self.report
        trains = bool(self.source.splits.get("train"))
        if not (survey.good.get("train") if trains else survey.good):
            alike: dict[str, list[Event]] = {}
            for event in report.refusals:
                alike.setdefault(event.what, []).append(event)
            refused = "; ".join(f"{events[0]}{f', and {len(events) - 1} more alike' * (len(events) > 1)}" for events in alike.values())
            raise ImportFailure(f"{report.source}: no {'training ' * trains}trajectory can be used: {refused or 'it holds none'}")
        assert survey.common is not None
        facts, (frame_dt, dim, periodic) = self.facts, survey.common
        spacing = facts.spacing or float(np.median(survey.spacings))
        radius = facts.connectivity_radius or float(np.median(survey.given_radii or survey.radii))
        bounds = facts.bounds
        if facts.spacing is None:
            report.notes.append(
                f"spacing {spacing:.4g} m is the median over trajectories (given values, else distances to the nearest node; spacing=…)"
            )
        if facts.connectivity_radius is None:
            report.notes.append(
                f"connectivity_radius is {radius / spacing:.3g} spacings (connectivity_radius=…, or later graph.connectivity_spacings=…)"
            )
        of_lengths = (
            ("spacing", survey.spacings, spacing, SAME_LENGTH if survey.has_given_spacings else SAME_MEASURED),
            ("connectivity_radius", survey.given_radii, radius, SAME_LENGTH),
        )
        for name, known, stored, most in of_lengths:
            if getattr(facts, name) is None and known and max(known) > most * min(known):
                report.warnings.append(
                    f"{name} is {min(known):.4g} … {max(known):.4g} m in the trajectories, and {stored:.4g} m is stored for all; choose {name}=…, "
                    "or import trajectories of different spacing as different data sets"
                )
        if bounds is None and not any(periodic):
            every = np.array(survey.bounds)
            bounds = tuple(zip(every[..., 0].min(axis=0).tolist(), every[..., 1].max(axis=0).tolist(), strict=True))
            report.notes.append("bounds enclose the bounds of all trajectories (given values, else the extremes of positions; bounds=…)")
        distance = float(np.median([nearest for _, _, nearest in survey.nearest]))
        if np.isfinite(distance) and not distance / SPACING_RATIO < spacing < distance * SPACING_RATIO:
            report.warnings.append(
                f"spacing is stored as {spacing:.4g} m, but nodes are {distance:.4g} m from the nearest one (median of first frames): spacing=… or bounds=… "
                "may be wrong"
            )
        self.facts = replace(facts, frame_dt=frame_dt, periodic=periodic, spacing=spacing, connectivity_radius=radius, bounds=bounds)
        self._compare_gravity(dim)
        self._compare_with_rounding()
        self._look_for_jumps(radius)
        survey.look_for_outliers()
        self._hold_out()
        report.warnings += survey.recordings.across({split: survey.good[split] for split in SPLITS if split in survey.good})
        report.dim, report.frame_dt, report.periodic = dim, frame_dt, list(periodic)
        report.spacing, report.connectivity_radius, report.origin = spacing, radius, self.origin.tolist()
        ratio = float(np.median(survey.velocity_ratios)) if survey.velocity_ratios else 1.0
        if not 1 / VELOCITY_RATIO < ratio < VELOCITY_RATIO:
            report.warnings.append(
                f"nodes move {ratio:.3g} times as far per frame as their velocities say: frame_dt may be {frame_dt * ratio:.3g} s rather than {frame_dt:g} s"
            )

    def _compare_gravity(self, dim: int) -> None:
        """Compare gravity with the acceleration of groups in free flight.

        If gravity is only assumed, and at least ``ENOUGH_GROUPS`` groups agree on another acceleration, that acceleration replaces it.
        """
        report, usual = self.report, self.facts.usual_gravity
        flights = [(f.assumed, f.free) for f in self.survey.flights]
        if any(self.survey.assumes_gravity) and usual is not None:
            known = f"gravity is not in the source; {vector(usual[:dim])} is the format's usual one"
            flight = joined((f for assumed, f in flights if assumed), dim)
            free = f"{flight.num_free} groups in free flight"
            if flight.num_free >= ENOUGH_GROUPS and flight.agrees_on_another:
                measured = tuple(float(f"{value:.3g}") for value in flight.typical)
                report.notes.append(f"{known}, but {free} accelerate by {vector(measured)}, which is stored (gravity=[…])")
                self.facts = replace(self.facts, usual_gravity=measured)
                change = np.subtract(measured, usual[:dim])
                self.survey.motions = [
                    (split, name, motion.with_gravity(change) if assumed else motion)
                    for (split, name, motion), assumed in zip(self.survey.motions, self.survey.assumes_gravity, strict=True)
                ]
                flights = [(assumed, f.under(measured) if assumed else f) for assumed, f in flights]
            elif flight.num_free >= ENOUGH_GROUPS:
                what = (
                    "have accelerations that differ from it and from each other"
                    if 2 * flight.num_disturbed > flight.num_free
                    else "confirm it"
                )
                report.notes.append(f"{known} and is stored: {free} {what} (gravity=[…])")
            else:
                report.notes.append(f"{known} and is stored: {free} are too few to measure it (gravity=[…])")
        flight = joined((f for _, f in flights), dim)
        report.free_groups, report.disturbed_groups = flight.num_free, flight.num_disturbed
        if flight.num_free:
            report.free_acceleration = flight.typical.tolist()
        if flight.agrees_on_another:
            stored = vector(np.median(flight.gravity, axis=0))
            report.warnings.append(
                f"gravity is stored as {stored}, but {flight.num_free} groups in free flight agree on {vector(flight.typical)}: "
                "gravity=[…], frame_dt=… or the unit of length may be wrong"
            )
        else:
            assumed = self.facts.usual_gravity
            self.survey.look_for_wrong_gravity(None if assumed is None else assumed[:dim])

    def _compare_with_rounding(self) -> None:
        """Choose the origin of stored positions (``better_origin``), and warn of trajectories whose rounding error is still large."""
        report, suspects, motions = self.report, self.survey.suspects, self.survey.motions
        typical = float(np.median([motion.acceleration for _, _, motion in motions]))
        nowhere = np.zeros_like(motions[0][2].low)
        self.origin = better_origin([motion for _, _, motion in motions], ROUNDING_FRACTION * typical)
        if self.origin.any():
            lost = max(motion.rounding(np.float32, nowhere).max() for _, _, motion in motions)
            where = ", ".join(f"{x:.12g}" for x in self.origin)
            what = f"float32 would round accelerations by {lost:.3g} m/s² so far from 0, those of the data are {typical:.3g} m/s² rms"
            report.repairs.append(Event("all splits", "all trajectories", -1, f"the origin was moved to ({where}) m: {what}"))
            self.about["origin"] = self.origin.tolist()
        for split, name, motion in motions:
            for error, where, remedy in (
                (motion.rounding_to_marks, f"in steps of {motion.marks.max():.3g} m", "write them with more digits"),
                (motion.rounding(motion.precision, nowhere), f"in {_steps_of(motion)}", "write them with more digits"),
                (motion.rounding(np.float32, self.origin), "in float32", "take a larger time step, or a smaller domain"),
            ):
                if fault := rounding_fault(float(error.max()), typical, where):
                    suspects.append(Event(split, name, -1, f"{fault}: {remedy}"))
                    break

    def _look_for_jumps(self, radius: float) -> None:
        """Warn of nodes that move farther than the connectivity radius in one frame."""
        for split, name, motion in self.survey.motions:
            if motion.step > radius:
                what = f"node {motion.node} moves by {motion.step:.4g} m in one frame, farther than the connectivity radius {radius:.4g} m"
                self.survey.suspects.append(Event(split, name, motion.frame, f"{what}: a fault of the source, or too few frames"))

    def _hold_out(self) -> None:
        """Take ``val`` and ``test`` from the end of the training trajectories if the source does not have them.

        Raises:
            ImportFailure: the source has such a split, and none of its trajectories can be used.
        """
        good, report = self.survey.good, self.report
        if unusable := [split for split in ("val", "test") if self.source.splits.get(split) and not good.get(split)]:
            refused = next(event for event in report.refusals if event.split == unusable[0])
            raise ImportFailure(
                f"{report.source}: no trajectory of {unusable[0]} can be used: {refused}; repair or remove it, or choose other trajectories with splits=…"
            )
        train = good.get("train", [])
        missing = [split for split in ("val", "test") if not good.get(split)]
        count = max(1, round(self.holdout * len(train)))
        if missing and self.holdout > 0 and len(train) > count * len(missing):
            for split in missing:
                good["train"], good[split] = good["train"][:-count], good["train"][-count:]
                moved = {item.name for item in good[split]}
                for events in (report.repairs, self.survey.suspects):
                    events[:] = [replace(e, split=split) if e.split == "train" and e.trajectory in moved else e for e in events]
                report.notes.append(f"the source has no {split}: the last {count} training trajectories were taken")
        elif missing:
            report.warnings.append(
                f"there is no split {' and no split '.join(missing)}; fit needs train, val and test, or three trajectories of train to take them from"
            )

    # --- second pass -----------------------------------------------------------------------------------------------------------------------

    def _write(self, folder: Path, split: str, items: Sequence[Item]) -> None:
        counts = self.report.splits.setdefault(split, SplitCounts())

        def stored(part: Sequence[Item]) -> Iterator[Trajectory]:
            for item in part:
                try:
                    trajectory = self._unified(self._load(item).trajectory, split)
                except (Refusal, ArrayError) as refusal:  # it does not fit the facts of the whole data set
                    self.report.refusals.append(Event(split, item.name, refusal.frame, str(refusal)))
                    continue
                counts.add(trajectory.num_frames, trajectory.num_nodes, len(trajectory.boundary.pos))
                self._count(trajectory, split)
                yield trajectory

        for k, start in enumerate(range(0, len(items), TRAJECTORIES_PER_SHARD)):
            part = items[start : start + TRAJECTORIES_PER_SHARD]
            write_shard(folder / split / f"shard-{k:05d}.h5", stored(part), (f"{start + i:05d}" for i in range(len(part))))
        if not counts.trajectories:
            raise ImportFailure(f"{self.report.source}: no trajectory of {split} can be used: {self.report.refusals[-1]}")

    def _unified(self, trajectory: Trajectory, split: str) -> Trajectory:
        """Give a trajectory the origin, metadata and material columns of the whole data set."""
        if self.origin.any():
            trajectory = trajectory.seen_from(self.origin)
        facts, m = self.facts, trajectory.metadata
        assert facts.spacing is not None and facts.connectivity_radius is not None
        materials = tuple(name for name in MATERIALS if name in self.survey.materials)
        names = param_names(materials, self.survey.columns)
        columns = np.full((trajectory.num_nodes, len(names)), np.nan, np.float32)
        for old, name in enumerate(m.param_names):
            columns[:, names.index(name)] = trajectory.material_params[:, old]
        stressed = tuple(name for name in materials if name in self.survey.stressed)
        metadata = replace(
            m, dataset=self.report.name, materials=materials, stress_materials=stressed, loads=tuple(name for name in LOADS if name in self.survey.loads),
            param_names=names, spacing=facts.spacing,
            connectivity_radius=facts.connectivity_radius, split=split,
            parameter_group="seen", solver=f"import/{self.about['format']}",
            solver_version=VERSION, config=json.dumps(self.about, sort_keys=True, default=str),
        )  # fmt: skip
        unified = replace(trajectory, metadata=metadata, material_params=columns)
        return (
            replace(unified, metadata=replace(metadata, parameter_group=self._unseen_group(unified))) if split == "test_unseen" else unified
        )

    def _unseen_group(self, trajectory: Trajectory) -> ParameterGroup:
        """Return the group of a trajectory of ``test_unseen``: ``extrapolated`` if a parameter is outside the range of training, else ``interpolated``."""
        return "extrapolated" if "extrapolated" in (group for *_, group in self.trained.groups(trajectory)) else "interpolated"

    def _count(self, trajectory: Trajectory, split: str) -> None:
        """Add a stored trajectory to the report."""
        report, m = self.report, trajectory.metadata
        so_far = report.bounds or m.bounds
        report.bounds = [[min(a[0], b[0]), max(a[1], b[1])] for a, b in zip(so_far, m.bounds, strict=True)]
        so_far = report.gravity or [[g, g] for g in m.gravity]
        report.gravity = [[min(low, g), max(high, g)] for (low, high), g in zip(so_far, m.gravity, strict=True)]
        for material in m.materials:
            rows = trajectory.node_type == node_code(material)
            if rows.any():
                entry = report.materials.setdefault(material, {"nodes": 0, "parameters": {}})
                entry["nodes"] += int(rows.sum())
                for parameter, column in zip(m.parameters_of(material), m.columns_of(material), strict=True):
                    values = trajectory.material_params[rows, column]
                    entry["parameters"][parameter.name] = _united(entry["parameters"].get(parameter.name), values)
        if split == "train":
            self.trained.add(trajectory)
        elif "train" in self.survey.good:
            report.warnings += [warning for warning in self._about_parameters(trajectory, split) if warning not in report.warnings]

    def _about_parameters(self, trajectory: Trajectory, split: str) -> Iterator[str]:
        """Yield warnings about materials and parameters of a trajectory that do not belong into its split."""
        for material in sorted({material for material, *_ in parameters_in(trajectory)} - self.trained.materials):
            yield f"{material} occurs in {split} but not in train: no model will know it"
        groups = [*self.trained.groups(trajectory)]
        for material, name, group in groups if split != "test_unseen" else ():
            if group == "extrapolated":
                yield f"{split} has values of {name} of {material} outside those of train, and counts as seen; such trajectories belong into test_unseen"
        if split == "test_unseen" and groups and all(group == "seen" for *_, group in groups):
            yield "test_unseen has trajectories whose parameters all occur in train, and counts as unseen; such trajectories belong into test"

    def _summarize(self, folder: Path) -> None:
        """Write statistics of the training trajectories (without any, of the first split), and report their neighbours and motion."""
        split = "train" if "train" in self.survey.good else next(iter(self.survey.good))
        shards = sorted((folder / split).glob("shard-*.h5"))
        statistics = combined([shard_moments(path)[1] for path in shards])
        sealed.write(folder / STATISTICS_FILE, {**statistics, "data_sha256": split_checksum(folder, split)})
        report = self.report
        shortest = min(counts.frames[0] for counts in report.splits.values())
        if shortest < SHORT:
            report.notes.append(
                f"trajectories have {shortest} frames or more, of which the default graph.history={HISTORY} takes {HISTORY} before a model can start; "
                "graph.history=1 takes one, and evaluation.start_time=0 starts at the first frame with its stored velocities"
            )
        report.velocity_std, report.acceleration_std = statistics["velocity_std"], statistics["acceleration_std"]
        if report.acceleration_std == 0:
            raise ImportFailure(
                f"{report.source}: nothing accelerates other than by gravity, so there is nothing to learn; check frame_dt and gravity, "
                "or add scenes in which nodes touch something"
            )
        sample = list(islice(iter_trajectories(folder, split), NUM_SAMPLED))
        if any(map(are_means, sample)):
            report.notes.append(ADVICE)
        degrees = [degree for trajectory in sample for degree in degrees_of(trajectory)]
        among, boundary = (np.concatenate(part) for part in zip(*degrees, strict=True))
        report.neighbours = {
            "mean": float(among.mean()),
            "min": int(among.min()),
            "max": int(among.max()),
            "boundary": float(boundary.mean()),
        }
        report.warnings += about_walls(sample)
        report.max_speed, report.mean_acceleration = speed_and_acceleration(sample)
        report.step_in_spacings = report.max_speed * report.frame_dt / report.spacing
        if not FEWEST_NEIGHBOURS <= among.mean() <= MOST_NEIGHBOURS:
            report.warnings.append(
                f"{among.mean():.1f} neighbours within the radius are {'few' if among.mean() < FEWEST_NEIGHBOURS else 'many'}; choose connectivity_radius=…"
            )


def _steps_of(motion: MotionSummary) -> str:
    """Return what positions are rounded to, for messages."""
    return "steps of 1 m, in whole numbers" if motion.is_whole else motion.precision.__name__


def _united(span: tuple[float, float] | None, values: np.ndarray) -> tuple[float, float]:
    """Return the smallest and largest value, those of an earlier span included."""
    low, high = span or (np.inf, -np.inf)
    return min(low, float(values.min())), max(high, float(values.max()))

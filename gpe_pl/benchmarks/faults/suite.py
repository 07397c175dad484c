"""The suite of faults: damaged files, hostile checkpoints, wrong values, full disks, killed and concurrent commands, and a matrix of the outcomes."""

from __future__ import annotations

import logging
import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from gpe_pl.benchmarks.faults import checkpoints, configs, field_values, isolation, outside, pairs, runs, scenes, side_files, stores
from gpe_pl.benchmarks.faults.runs import Command
from gpe_pl.benchmarks.faults.verdict import BAD, GOOD, Fault, Verdict
from gpe_pl.benchmarks.trained import Case
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.system.progress import progress_bar

log = logging.getLogger(__name__)

Count = Annotated[int, Field(ge=0)]
KILLED = "killed"
TEMPORARY = re.compile(r"\S*/faults-\w+/")
"""Pattern of the folders in which faults are injected."""
HERE = str(Path(__file__).resolve().parents[3])
"""Folder that contains the package. Reports leave it out, because it differs between machines."""


RAW = "raw"
"""Folder of the arrays that ``convert`` reads."""
OF_DATA, READS_DATA = ("simulate", "fit", "evaluate"), ("fit", "evaluate")
"""Commands that have a data set, and commands that read one."""
DELETED = {"simulate": ("data",), "convert": ("data",), "fit": ("data", "runs"), "evaluate": ("runs",), "benchmark": ("runs",)}
"""Folders that are deleted while a command runs."""


class PreparationError(GpeError):
    """Raised when an undisturbed command fails; the message contains the end of its output."""


@dataclass(frozen=True)
class Attacked:
    """A command that is attacked, and numbers of attacks.

    Attributes:
        module: module in ``python -m gpe_pl.{module}``.
        arguments: further overrides, chosen so that the command takes one or two seconds. ``{root}`` stands for the folder with a subfolder for each command.
        others: overrides of variants of the command, by name. Each variant, and a second copy of the command, runs at the same time in the same folder.
        num_pairs: number of runs of each such pair.
        num_deletions: number of deletions of its folders while it runs.
        num_kills: number of kills at random moments.
        num_configs: number of wrong configurations.
        num_damages: number of damages to its files, each followed by the same command.
        num_contents: number of changes to its small files, each followed by the same command.
        names: keys whose values become names of folders.
        leads_out: also try links, and paths in checkpoints, that lead out of its folder.
        disk_sizes: sizes of disks that fill up [bytes], less than the largest file that the command writes.
    """

    module: Annotated[str, Field(pattern="^(simulate|fit|evaluate|convert|benchmark)$")]
    arguments: list[str]
    others: dict[str, list[str]] = field(default_factory=dict)
    num_pairs: Count = 0
    num_deletions: Count = 0
    num_kills: Count = 0
    num_configs: Count = 0
    num_damages: Count = 0
    num_contents: Count = 0
    names: list[str] = field(default_factory=list)
    leads_out: bool = False
    disk_sizes: list[Annotated[int, Field(ge=1)]] | None = None


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets whose scenes are changed.
        data: overrides of every command that has a data set; they select a miniature data set.
        values: data sets, among the cases, whose stored arrays get wrong values.
        commands: attacked commands; the first generates the data of the others, and the first checkpoint among their results is damaged.
        num_file_damages: number of damages to the bytes of a shard, and of a checkpoint.
        num_scenes: number of scenes of each data set, for each change.
        limit: time [s] after which a command counts as hung. A fault, which may run several, has four times as long.
        seed: seed of all random choices.
    """

    cases: dict[str, Case]
    data: list[str]
    commands: dict[str, Attacked]
    values: list[str] = field(default_factory=list)
    num_file_damages: Count = 300
    num_scenes: Count = 1
    limit: Annotated[float, Field(gt=0)] = 600.0
    seed: Count = 0


def run(settings: Settings, specs: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """Return a record per fault, and a Markdown table of their counts.

    Raises:
        PreparationError: an undisturbed command fails.
        IsolationError: the system cannot fork processes.
        NoConfigError: an undisturbed command does not print its configuration.
        DiskSizeError: a disk would not fill up.
    """
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        root = Path(folder)
        root.chmod(0o755)
        commands = _prepared(settings, root)
        faults = _faults(settings, specs, commands, root)
        with progress_bar("faults") as on_progress:
            for done, (fault, verdict) in enumerate(zip(faults, isolation.verdicts(faults, 4 * settings.limit), strict=True), start=1):
                _note(records, fault.kind, fault.name, verdict)
                on_progress(done, len(faults))
        for name, command in commands.items():
            count = settings.commands[name].num_kills
            if count:
                with progress_bar(f"kills of {name}") as on_progress:
                    found = runs.kills(command, root / f"kills-{name}", count, seed=settings.seed, limit=settings.limit)
                    for done, verdict in enumerate(found, start=1):
                        _note(records, f"{name} {KILLED}", "", verdict)
                        on_progress(done, count)
    return records, report(records)


def failures(records: list[dict[str, Any]]) -> list[str]:
    """Return the faults with a bad status, as lines of text."""
    return [f"{r['kind']}, {r['fault']}: {r['status']}" for r in records if r["status"] in BAD]


def _note(records: list[dict[str, Any]], kind: str, name: str, verdict: Verdict) -> None:
    detail = TEMPORARY.sub("", verdict.detail).replace(HERE, "…")
    records.append({"kind": kind, "fault": name, "status": verdict.status, "detail": detail})
    if verdict.status in BAD:
        log.warning("%s, %s: %s: %s", kind, name, verdict.status, detail)


def _prepared(settings: Settings, root: Path) -> dict[str, Command]:
    """Return the commands, each after an undisturbed run in a separate folder; the others use the data of the first."""
    commands: dict[str, Command] = {}
    data: str | None = None
    side_files.raw_arrays(root / RAW)
    for name, attacked in settings.commands.items():
        arguments = [argument.replace("{root}", str(root)) for argument in attacked.arguments]
        if attacked.module in OF_DATA:
            arguments = [*settings.data, *arguments]
        command = Command(name, attacked.module, tuple(arguments), data if attacked.module in READS_DATA else None)
        _timed(replace(command, name=f"{name} for the first time"), settings, root)  # the first run compiles
        command = _timed(command, settings, root)
        for other, overrides in attacked.others.items():
            _timed(replace(command, name=f"{name} {other}", arguments=(*command.arguments, *overrides)), settings, root)
        data = data or str(root / name / "data")
        commands[name] = command
    return commands


def _timed(command: Command, settings: Settings, root: Path) -> Command:
    """Run a command undisturbed in a separate folder, and return it with its duration."""
    given, started = command.given(root / command.name), time.monotonic()
    ended = isolation.run(command.module, given, settings.limit)
    if ended.code != 0:
        raise PreparationError(f"{command.module} {' '.join(given)} ended with {ended.code}: {ended.output[-1000:]}")
    seconds = time.monotonic() - started
    log.info("%s takes %.1f s", command.name, seconds)
    return replace(command, seconds=seconds)


def _faults(settings: Settings, specs: dict[str, DatasetSpec], commands: dict[str, Command], root: Path) -> list[Fault]:
    """Return all faults except kills."""
    found = scenes.faults(specs, settings.num_scenes)
    found += field_values.faults(field_values.shards({name: specs[name] for name in settings.values}, root / "values"), settings.seed)
    found += side_files.faults(root / RAW)
    shards, saved = sorted(root.rglob("train/shard-*.h5")), sorted(root.rglob("best.ckpt"))
    if shards:
        found += stores.faults(shards[0], settings.num_file_damages, settings.seed)
    if saved:
        found += checkpoints.faults(saved[0], settings.num_file_damages, settings.seed)
    for name, command in commands.items():
        attacked, sound = settings.commands[name], root / name
        left = runs.digests(sound)
        both = left | runs.digests(root / next(iter(commands))) if command.data else left
        if attacked.num_configs:
            found += configs.faults(command, both, attacked.num_configs, settings.seed, settings.limit)
        found += runs.damage_faults(command, sound, attacked.num_damages, settings.seed, settings.limit)
        found += side_files.command_faults(command, sound, attacked.num_contents, settings.seed, settings.limit)
        found += outside.faults(command, sound, attacked.names, attacked.leads_out, settings.limit)
        if attacked.num_pairs:
            found += pairs.pair_faults(_pairs(settings, name, commands, root), attacked.num_pairs, settings.seed, settings.limit)
        expected = {"data": both, "runs": left}
        for part in DELETED[attacked.module] if attacked.num_deletions else ():
            found += pairs.deletion_faults(command, part, expected[part], attacked.num_deletions, settings.seed, settings.limit)
        if attacked.disk_sizes is not None:
            found += runs.disk_faults(command, attacked.disk_sizes, sound, left, settings.limit)
    return found


def _pairs(settings: Settings, name: str, commands: dict[str, Command], root: Path) -> Iterator[tuple[pairs.Leaving, pairs.Leaving]]:
    """Yield pairs of commands to start at once in one folder.

    Each command is paired with itself and with its variants (``Attacked.others``), a training also with the command that generates its data.
    """
    command = commands[name]
    own = pairs.Leaving(command, runs.digests(root / name))
    yield own, own
    for other, overrides in settings.commands[name].others.items():
        different = replace(command, name=f"{name} {other}", arguments=(*command.arguments, *overrides))
        yield own, pairs.Leaving(different, runs.digests(root / different.name))
    if command.data is not None and command.module == "fit":
        first = next(iter(commands))
        data = runs.digests(root / first)
        yield pairs.Leaving(commands[first], data), pairs.Leaving(replace(command, data=None), own.results | data)


# --- the matrix -----------------------------------------------------------------------------------------------------------------------------


def report(records: Sequence[dict[str, Any]]) -> str:
    """Return counts, a row per kind of fault, and every fault with a bad outcome."""
    killed = [r for r in records if r["kind"].endswith(KILLED)]
    bad = [r for r in records if r["status"] in BAD]
    inputs = [r for r in records if not r["kind"].endswith(KILLED)]
    counts = {status: sum(r["status"] == status for r in inputs) for status in ("traceback", "accepted", "executed", "outside", "hung")}
    lines = [
        f"{len(inputs)} corrupted or hostile inputs: {counts['traceback']} tracebacks without a typed error, {counts['accepted']} silent acceptances, "
        f"{counts['executed']} executed payloads, {counts['outside']} paths outside, {counts['hung']} hangs over {isolation.HANG:g} s, "
        f"{sum(r['status'] in BAD for r in inputs) - sum(counts.values())} other failures. "
        f"{len(killed)} kills: {sum(r['status'] == 'harmless' for r in killed)} followed by results that are equal bit for bit.",
        "",
        *_table(records),
    ]
    if bad:
        lines += ["", f"**{len(bad)} failures**", "", *_failures(bad)]
    return "\n".join(lines)


def _table(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    statuses = [s for s in (*GOOD, *BAD) if any(r["status"] == s for r in records)]
    yield table_row(["fault", "number", *statuses])
    yield "|" + "---|" * (2 + len(statuses))
    for kind in dict.fromkeys(r["kind"] for r in records):
        counts = Counter(r["status"] for r in records if r["kind"] == kind)
        yield table_row([kind, str(counts.total()), *(str(counts[s]) for s in statuses)])


def _failures(bad: Sequence[dict[str, Any]], most: int = 5) -> Iterator[str]:
    """Yield some failures of each kind."""
    seen: Counter[str] = Counter()
    for r in bad:
        seen[r["kind"]] += 1
        if seen[r["kind"]] <= most:
            text = f"{r['kind']}, {r['fault']}: {r['status']}: {r['detail']}".replace("|", "\\|").replace("\n", " ")
            yield f"- {text}"

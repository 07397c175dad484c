"""What comes of damaged files, hostile checkpoints, wrong configurations, impossible scenes, full disks and killed commands: a matrix with counts."""

from __future__ import annotations

import logging
import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from gpe_pl.errors import GpeError
from gpe_pl.faults import checkpoints, configs, isolation, runs, scenes, stores
from gpe_pl.faults.runs import Command
from gpe_pl.faults.verdict import BAD, GOOD, Fault, Verdict
from gpe_pl.ground_truth import DatasetSpec
from gpe_pl.markdown import table_row
from gpe_pl.suites.trained import Case

log = logging.getLogger(__name__)

Count = Annotated[int, Field(ge=0)]
KILLED = "killed"
TEMPORARY = re.compile(r"\S*/faults-\w+/")
"""Folders in which faults were done."""


class PreparationError(GpeError):
    """A command that nothing was done to has failed; the message says how."""


@dataclass(frozen=True)
class Attacked:
    """A command that is attacked.

    Attributes:
        module: ``python -m gpe_pl.{module}``.
        arguments: further overrides, that make it last a second or two.
        num_kills: at random moments.
        num_configs: wrong configurations.
        num_damages: of files that it has left, each followed by the same command.
        disk_sizes: of disks that fill up, in bytes.
    """

    module: Annotated[str, Field(pattern="^(simulate|fit)$")]
    arguments: list[str]
    num_kills: Count = 0
    num_configs: Count = 0
    num_damages: Count = 0
    disk_sizes: list[Annotated[int, Field(ge=1)]] | None = None


@dataclass(frozen=True)
class Settings:
    """How much of each.

    Attributes:
        cases: data sets whose scenes are changed.
        data: overrides of every command: the data set, in miniature.
        commands: the first generates the data that the others use; the first checkpoint that one leaves is damaged.
        num_file_damages: of a shard's bytes, and of a checkpoint's.
        num_scenes: of each data set, for each change.
        limit: seconds after which something hangs.
        seed: of everything random.
    """

    cases: dict[str, Case]
    data: list[str]
    commands: dict[str, Attacked]
    num_file_damages: Count = 300
    num_scenes: Count = 1
    limit: Annotated[float, Field(gt=0)] = 600.0
    seed: Count = 0


def run(settings: Settings, specs: dict[str, DatasetSpec]) -> tuple[list[dict[str, Any]], str]:
    """A record per fault, and a Markdown table of their counts."""
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        root = Path(folder)
        root.chmod(0o755)
        commands = _prepared(settings, root)
        faults = _faults(settings, specs, commands, root)
        for fault, verdict in zip(faults, isolation.verdicts(faults, 4 * settings.limit), strict=True):
            _note(records, fault.kind, fault.name, verdict)
        for name, command in commands.items():
            count = settings.commands[name].num_kills
            for verdict in runs.kills(command, root / f"kills-{name}", count, seed=settings.seed, limit=settings.limit) if count else ():
                _note(records, f"{name} {KILLED}", "", verdict)
    return records, report(records)


def failures(records: list[dict[str, Any]]) -> list[str]:
    """What was not survived, or accepted, executed or kept silent about."""
    return [f"{r['kind']}, {r['fault']}: {r['status']}" for r in records if r["status"] in BAD]


def _note(records: list[dict[str, Any]], kind: str, name: str, verdict: Verdict) -> None:
    detail = TEMPORARY.sub("", verdict.detail)
    records.append({"kind": kind, "fault": name, "status": verdict.status, "detail": detail})
    if verdict.status in BAD:
        log.warning("%s, %s: %s: %s", kind, name, verdict.status, detail)


def _prepared(settings: Settings, root: Path) -> dict[str, Command]:
    """The commands, each of which has been run undisturbed in a folder of its own, the first one's data serving the others."""
    commands: dict[str, Command] = {}
    data: str | None = None
    for name, attacked in settings.commands.items():
        command = Command(name, attacked.module, (*settings.data, *attacked.arguments), data)
        started = time.perf_counter()
        ended = isolation.run(command.module, command.given(root / name), settings.limit)
        if ended.code != 0:
            raise PreparationError(
                f"{attacked.module} {' '.join(command.given(root / name))} ended with {ended.code}: {ended.output[-1000:]}"
            )
        log.info("%s takes %.1f s", name, time.perf_counter() - started)
        data = data or str(root / name / "data")
        commands[name] = command
    return commands


def _faults(settings: Settings, specs: dict[str, DatasetSpec], commands: dict[str, Command], root: Path) -> list[Fault]:
    """Everything that is wrong but no kill."""
    found = scenes.faults(specs, settings.num_scenes)
    shards, saved = sorted(root.rglob("train/shard-*.h5")), sorted(root.rglob("best.ckpt"))
    if shards:
        found += stores.faults(shards[0], settings.num_file_damages, settings.seed)
    if saved:
        found += checkpoints.faults(saved[0], settings.num_file_damages, settings.seed)
    for name, command in commands.items():
        attacked, sound = settings.commands[name], root / name
        given = [*command.arguments, f"paths.data={command.data or sound / 'data'}"]
        if attacked.num_configs:
            found += configs.faults(command.module, given, attacked.num_configs, settings.seed, settings.limit)
        found += runs.damage_faults(command, sound, attacked.num_damages, settings.seed, settings.limit)
        if attacked.disk_sizes is not None:
            found += runs.disk_faults(command, attacked.disk_sizes, runs.digests(sound), settings.limit)
    return found


# --- the matrix -----------------------------------------------------------------------------------------------------------------------------


def report(records: Sequence[dict[str, Any]]) -> str:
    """Counts, a row per kind of fault, and every fault of which nothing good came."""
    killed = [r for r in records if r["kind"].endswith(KILLED)]
    bad = [r for r in records if r["status"] in BAD]
    inputs = [r for r in records if not r["kind"].endswith(KILLED)]
    counts = {status: sum(r["status"] == status for r in inputs) for status in ("traceback", "accepted", "executed")}
    lines = [
        f"{len(inputs)} corrupted or hostile inputs: {counts['traceback']} tracebacks without a typed error, {counts['accepted']} silent acceptances, "
        f"{counts['executed']} executed payloads, {sum(r['status'] in BAD for r in inputs) - sum(counts.values())} other failures. "
        f"{len(killed)} kills: {sum(r['status'] == 'harmless' for r in killed)} followed by results that are equal bit for bit.",
        "",
        *_table(records),
    ]
    if bad:
        lines += ["", f"**{len(bad)} failures**", "", *_failures(bad)]
    return "\n".join(lines)


def _table(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    statuses = [*GOOD, *(s for s in BAD if any(r["status"] == s for r in records))]
    yield table_row(["fault", "number", *statuses])
    yield "|" + "---|" * (2 + len(statuses))
    for kind in dict.fromkeys(r["kind"] for r in records):
        counts = Counter(r["status"] for r in records if r["kind"] == kind)
        yield table_row([kind, str(counts.total()), *(str(counts[s]) for s in statuses)])


def _failures(bad: Sequence[dict[str, Any]], most: int = 5) -> Iterator[str]:
    """Some of each kind."""
    seen: Counter[str] = Counter()
    for r in bad:
        seen[r["kind"]] += 1
        if seen[r["kind"]] <= most:
            text = f"{r['kind']}, {r['fault']}: {r['status']}: {r['detail']}".replace("|", "\\|").replace("\n", " ")
            yield f"- {text}"

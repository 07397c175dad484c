"""Faults of concurrency: two commands at once in one folder, and folders that are deleted under a running command.

Commands run in the empty folder ``folder``, each for at most ``limit`` seconds. ``expected`` are the digests of results of undisturbed commands.
"""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gpe_pl.benchmarks.faults import isolation, runs
from gpe_pl.benchmarks.faults.runs import Command
from gpe_pl.benchmarks.faults.verdict import GOOD, MAX_DETAIL, Fault, Verdict

SAYS_WHY = re.compile(r"another command writes to it \((process \d+ on .+|which has just begun)\)|exists already")
"""Messages with which a command may refuse while the other one runs: the other one holds the folder, or its results already exist."""
Results = dict[str, str]
"""Digests of a command's results, see ``runs.digests``."""


def together(commands: Sequence[Command], expected: Sequence[Results], delay: float, limit: float, folder: Path) -> Verdict:
    """Start two commands in one folder, the second ``delay`` seconds after the first.

    The outcome is sound if a command succeeds and the folder contains exactly the results of those that do. A command that is refused before the other ends has
    to name it, or to say that its results exist.
    """
    own, outputs = folder / "own", [folder / f"output-{k}" for k in range(len(commands))]
    processes = []
    try:
        for k, command in enumerate(commands):
            time.sleep(delay if k else 0.0)
            processes.append(isolation.start(command.module, command.given(own), outputs[k]))
        deadline, order = time.monotonic() + limit, list[int]()
        while len(order) < len(processes) and time.monotonic() < deadline:
            order += [k for k, process in enumerate(processes) if k not in order and isolation.waited(process, 0.05)]
    finally:
        for process in processes:
            isolation.end(process)
    verdicts, printed = [], [output.read_text(encoding="utf-8", errors="replace") for output in outputs]
    for k, process in enumerate(processes):
        verdicts.append(isolation.Ended(process.exitcode if k in order else None, printed[k]).verdict())
        if verdicts[k].status not in GOOD:
            return verdicts[k]
    done = [k for k, verdict in enumerate(verdicts) if verdict.status == "harmless"]
    refused = "; ".join(verdict.detail for verdict in verdicts if verdict.status == "refused")
    if not done:
        return Verdict("different", f"none succeeded: {refused}"[:MAX_DETAIL])
    if refused and order[0] not in done and not SAYS_WHY.search(printed[order[0]]):  # a verdict contains only the beginning of the output
        return Verdict("accepted", f"does not say why: {refused}"[:MAX_DETAIL])
    found = runs.digests(own)
    wrong = {name for k in done for name, digest in expected[k].items() if found.get(name) != digest}
    wrong |= found.keys() - {name for k in done for name in expected[k]}
    if wrong:
        return Verdict("different", f"{', '.join(sorted(wrong))}; {refused}"[:MAX_DETAIL])
    if left := runs.leftovers(own):
        return Verdict("half-written", f"left behind: {', '.join(left)}")
    return Verdict("refused", refused) if refused else Verdict("harmless", "both succeeded, with what each leaves alone")


def deleted(command: Command, part: str, delay: float, expected: Results, limit: float, folder: Path) -> Verdict:
    """Delete a ``part`` of a command's folder, ``data`` or ``runs``, ``delay`` seconds after its start.

    The command must fail with an error or succeed, and its repetition must succeed.

    If the data are to be deleted, the command works on a copy of them and generates them again if they are missing.
    """
    own = folder / "own"
    if command.data is not None and part == "data":
        shutil.copytree(command.data, own / "data")
        command = replace(command, data=None)
    process = isolation.start(command.module, command.given(own), folder / "output")
    try:
        isolation.waited(process, delay)
        for path in (own / part).glob("[!.]*"):
            shutil.rmtree(path, ignore_errors=True)
        done = isolation.waited(process, limit)
    finally:
        isolation.end(process)
    ended = isolation.Ended(process.exitcode if done else None, (folder / "output").read_text(encoding="utf-8", errors="replace"))
    verdict = ended.verdict()
    if verdict.status not in GOOD:
        return verdict
    if verdict.status == "harmless":
        found = runs.digests(own)
        if wrong := sorted(name for name, digest in found.items() if expected.get(name, digest) != digest):
            return Verdict("different", ", ".join(wrong)[:MAX_DETAIL])
    again = runs.finished(command, own, expected, limit)
    return again if again.status != "harmless" else Verdict(verdict.status, f"{verdict.detail}; then {again.detail}"[:MAX_DETAIL])


@dataclass(frozen=True)
class Leaving:
    """A command, and the results that it leaves if it starts in an empty folder."""

    command: Command
    results: Results


def pair_faults(couples: Iterable[tuple[Leaving, Leaving]], count: int, seed: int, limit: float) -> list[Fault]:
    """Return ``count`` faults for every couple of commands, the second started a random time after the first."""
    rng, found = np.random.default_rng(seed), []
    for first, second in couples:
        for _ in range(count):
            delay = float(rng.uniform(0, 0.8) * first.command.seconds)
            attack = partial(together, (first.command, second.command), (first.results, second.results), delay, limit)
            name = f"{first.command.name}, {second.command.name} after {delay:.2f} s"
            found.append(Fault("two commands at once", name, attack, 2 * (first.command.seconds + second.command.seconds)))
    return found


def deletion_faults(command: Command, part: str, expected: Results, count: int, seed: int, limit: float) -> list[Fault]:
    """Return deletions of a part of a command's folder at random moments; ``expected`` are the command's final results."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        delay = float(rng.uniform(0, 0.9) * command.seconds)
        attack = partial(deleted, command, part, delay, expected, limit)
        found.append(Fault("folder deleted", f"{command.name}, {part} after {delay:.2f} s", attack, 3 * command.seconds))
    return found

"""Faults of configurations: wrong types, missing and misspelt keys, and absurd values, as overrides of a command."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gpe_pl.benchmarks.faults.isolation import run
from gpe_pl.benchmarks.faults.runs import Command, compared
from gpe_pl.benchmarks.faults.verdict import Fault, Verdict
from gpe_pl.errors import GpeError

PLACES = (
    "paths",
    "hydra",
    "size",
    "data.dimensions",
    "data.sizes",
    "data.showcase",
    "data.larger",
    "logger.project",
)
"""Keys that are never changed: paths, and tables that only hold values for other keys, most of which are unused."""
UNBOUNDED = ("training.num_steps", "training.val_interval", "seed", "data.seed", "num_workers")
"""Integers without an upper limit."""


class NoConfigError(GpeError):
    """Raised when a command does not print its configuration; the message contains its output."""


def leaves(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield key and value of every entry of a configuration that is not itself a table, except entries of ``PLACES``."""
    if isinstance(values, dict) and values:
        for key, value in values.items():
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    elif not str(path).startswith(PLACES):
        yield path, values


def mutations(key: str, value: Any) -> Iterator[tuple[str, str, bool]]:
    """Yield kind and override of every mutation of a key, and whether the command must refuse it."""
    parent, _, leaf = key.rpartition(".")
    yield "unknown key", f"+{parent + '.' if parent else ''}{leaf}_typo=1", True
    yield "missing key", f"~{key}", False  # the default of the signature may apply
    if isinstance(value, bool):
        wrong, absurd = ["banana", "7", "[true]", "{a:1}", "0.5"], []
    elif isinstance(value, int):
        wrong, absurd = ["banana", "[1]", "{a:1}", "0.123", "nan", "inf"], ["-7", *([] if key in UNBOUNDED else [str(10**30)])]
    elif isinstance(value, float):
        wrong, absurd = ["banana", "[[1]]", "{a:1}", "nan", "inf"], ["-1e300", "1e300", "-1"]
    elif isinstance(value, str):
        wrong, absurd = ["[1]", "{a:1}"], ["''", "no_such_thing", "'../../outside'", "'\\x00'"]
    elif isinstance(value, list):
        wrong, absurd = ["banana", "{a:1}", "[banana]", "[[[1]]]", "[nan]"], ["[]", "[-1e300]", "[-7]"]
    else:
        wrong, absurd = ["{a:{b:1}}"], []
    for text in wrong:
        yield "wrong type", f"{key}={text}", True
    for text in absurd:
        yield "absurd value", f"{key}={text}", False


def started(command: Command, override: str, must_fail: bool, expected: dict[str, str], limit: float, folder: Path) -> Verdict:
    """Start a command with one additional override, and return the verdict.

    If it may succeed and does, its results are compared with those without the override: ``harmless`` means equal, ``changed`` that the override had an effect.

    A command that makes data starts in an empty folder, because it refuses every other setting where data exist. One that reads data has a copy of them.

    Args:
        command: the undisturbed command.
        override: the additional override.
        must_fail: whether the command has to refuse it.
        expected: digests of the results, data included, without the override.
        limit: time [s] after which the command is stopped.
        folder: empty folder of its data and results.
    """
    if command.data is not None:
        shutil.copytree(command.data, folder / "data")
        command = replace(command, data=None)
    ended = run(command.module, [*command.given(folder), override], limit)
    verdict = ended.verdict("accepted" if must_fail else "harmless")
    if verdict.status in ("harmless", "refused") and list(folder.rglob("*.part*")):
        return Verdict("half-written", verdict.detail)
    if verdict.status == "harmless":
        verdict = compared(folder, expected, verdict.detail)
        return Verdict("changed", verdict.detail) if verdict.status == "different" else verdict
    return verdict


def faults(command: Command, expected: dict[str, str], count: int, seed: int = 0, limit: float = 120.0) -> list[Fault]:
    """Return mutations of the configuration of a command.

    Args:
        command: the undisturbed command; some mutations change nothing, and it then runs to its end.
        expected: digests of its results and data.
        count: number of mutations, divided equally among the kinds.
        seed: seed of their choice.
        limit: time [s] after which a command is stopped.

    Raises:
        NoConfigError: the undisturbed arguments are refused.
    """
    shown = run(command.module, [*command.arguments, "--cfg", "job", "--resolve"])
    if shown.code != 0:
        raise NoConfigError(f"{command.module} {' '.join(command.arguments)}: {shown.output}")
    rng = np.random.default_rng(seed)
    by_kind: dict[str, list[tuple[str, bool]]] = {}
    for key, value in leaves(yaml.safe_load(shown.output)):
        for kind, override, must_fail in mutations(key, value):
            by_kind.setdefault(kind, []).append((override, must_fail))
    found = []
    for kind, every in by_kind.items():
        chosen = rng.permutation(len(every))[: math.ceil(count / len(by_kind))]
        for override, must_fail in (every[k] for k in sorted(chosen)):
            attack = partial(started, command, override, must_fail, expected, limit)
            found.append(Fault(f"configuration, {kind}", f"{command.module} {override}", attack, command.seconds))
    return found

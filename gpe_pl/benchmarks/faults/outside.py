"""Faults with names, links and checkpoints that point out of the folders of a command.

Commands run in the empty folder ``folder``, for at most ``limit`` seconds. ``sound`` is the folder of an undisturbed run.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gpe_pl.benchmarks.faults import isolation, runs
from gpe_pl.benchmarks.faults.isolation import CANARY
from gpe_pl.benchmarks.faults.runs import Command
from gpe_pl.benchmarks.faults.verdict import Fault, Verdict

LEADING_OUT = ("../../canary", "a/../../../canary", "{canary}", "file://{canary}", "../../canary/../canary/x", "..", ".", "/")
"""Names that lead outside; ``{canary}`` stands for the path of a folder beside that of the command."""


def named(command: Command, key: str, name: str, limit: float, folder: Path) -> Verdict:
    """Give a command a ``name`` that leads outside, as the value of the setting ``key``; it must refuse the name."""
    override = f"{key}='{name.replace('{canary}', str(folder.parent / CANARY))}'"
    return isolation.run(command.module, [*command.given(folder / "own"), override], limit).verdict("accepted")


def linked(command: Command, sound: Path, part: str, target: str, limit: float, folder: Path) -> Verdict:
    """Replace a ``part`` of a command's results by a link to ``target`` in a folder outside, and repeat the command."""
    own = folder / "own"
    shutil.copytree(sound, own)
    path = own / part
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.symlink_to(folder.parent / CANARY / target)
    for finished in own.rglob("metrics.csv*"):  # so that the command writes again
        if not finished.is_symlink():
            finished.unlink()
    return isolation.run(command.module, command.given(own), limit).verdict()


def interrupted(command: Command, limit: float, folder: Path) -> Path | None:
    """Kill a training once it has saved ``last.ckpt``, and return its path; return None if it ended or reached the time limit first."""
    process = isolation.start(command.module, command.given(folder), folder.parent / "output")
    deadline = time.monotonic() + limit
    try:
        while time.monotonic() < deadline and not isolation.waited(process, 0.02):
            for last in folder.rglob("last.ckpt"):
                process.kill()
                return last
    finally:
        isolation.end(process)
    return None


STATES: dict[str, Callable[[str], dict[str, Any]]] = {
    "best": lambda path: {"best_model_path": path, "best_model_score": torch.tensor(1e9), "current_score": torch.tensor(1e9)},
    "last": lambda path: {"last_model_path": path},
    "folder": lambda path: {"dirpath": str(Path(path).parent)},
    "worst of the best": lambda path: {
        "kth_best_model_path": path,
        "kth_value": torch.tensor(1e9),
        "best_k_models": {path: torch.tensor(1e9)},
    },
    "own": lambda path: {"best": path, "last": path},
    "in place of numbers": lambda path: {"best_step": path, "lowest": [path]},
}
"""States of callbacks in a checkpoint that name a path. A training stores no path; only the last state replaces entries that it reads."""


def resumed(command: Command, state: str, path: str, expected: dict[str, str], limit: float, folder: Path) -> Verdict:
    """Interrupt a training, put a path that leads outside into the states of callbacks in its checkpoint (see ``STATES``), and repeat the command.

    It must refuse the checkpoint or end with the results whose digests are ``expected``.
    """
    own = folder / "own"
    own.mkdir()
    last = interrupted(command, limit, own)
    if last is None:
        return Verdict("harmless", "not done: the training ended before it was interrupted")
    stored = torch.load(last, weights_only=True)
    evil = STATES[state](path.replace("{canary}", str(folder.parent / CANARY)))
    names = [*stored["callbacks"], "ModelCheckpoint", "Checkpoints"]
    stored["callbacks"] = {name: {**(stored["callbacks"].get(name) or {}), **evil} for name in names}
    torch.save(stored, last)
    verdict = isolation.run(command.module, command.given(own), limit).verdict()
    return runs.compared(own, expected, verdict.detail) if verdict.status == "harmless" else verdict


def faults(command: Command, sound: Path, keys: Sequence[str], also_files: bool, limit: float) -> list[Fault]:
    """Return names for each key. With ``also_files``, also return links in place of the files of a run or data set, and paths in checkpoints of trainings."""
    found = []
    for key in keys:
        for name in LEADING_OUT:
            found.append(
                Fault("name that leads out", f"{command.name}: {key}={name}", partial(named, command, key, name, limit), command.seconds)
            )
    if not also_files:
        return found
    folders = sorted({path.parent for path in sound.rglob("*.json") if "log" not in path.parts})
    for each in sorted(path for folder in folders for path in folder.iterdir() if not path.name.startswith(".")):
        part, target = str(each.relative_to(sound)), "checkpoints" if each.is_dir() else "metrics.csv"
        attack = partial(linked, command, sound, part, target, limit)
        found.append(Fault("link that leads out", f"{command.name}: {part}", attack, command.seconds))
    if any(sound.rglob("last.ckpt")):
        expected = runs.digests(sound)
        for state in STATES:
            for path in (
                "{canary}/checkpoints/best.ckpt",
                "file://{canary}/checkpoints/best.ckpt",
                "../../../../../canary/checkpoints/best.ckpt",
            ):
                attack = partial(resumed, command, state, path, expected, limit)
                found.append(Fault("checkpoint that leads out", f"{command.name}: {state}, {path}", attack, 2 * command.seconds))
    return found

"""Verdicts of the suites ``acceptance`` and ``stability`` on a checkpoint, stored beside it as ``{stem}.acceptance.json`` and ``{stem}.stability.json``.

Each file holds the checksum of the checkpoint, so results of another checkpoint are never shown. It is plain JSON with typed values, and nothing in it is
loaded as code.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gpe_pl.errors.printable import one_line
from gpe_pl.files import sealed
from gpe_pl.learned.pretrained import checkpoint_path

Suite = Literal["acceptance", "stability"]
NOT_MEASURED = "acceptance not measured"
NOT_TESTED = "stress tests not measured"


@dataclass(frozen=True, config={"extra": "forbid", "strict": True})
class Check:
    """Result of one check.

    Attributes:
        name: scene and quantity, or number and name of a stress test.
        passed: whether the criterion holds.
        measured: numbers of the model, with units.
        solver: numbers of the solver; empty if the criterion does not need them.
        limit: the criterion.
    """

    name: str
    passed: bool
    measured: str
    solver: str
    limit: str

    def __str__(self) -> str:
        reference = f", solver {self.solver}" if self.solver else ""
        return f"{'pass' if self.passed else 'FAIL'} {self.name}: measured {self.measured}{reference}, limit {self.limit}"


@dataclass(frozen=True, config={"extra": "forbid", "strict": True})
class Verdict:
    """All checks of a checkpoint by one suite.

    Attributes:
        checkpoint: SHA-256 of the checkpoint's file.
        checks: results in the order of the suite.
    """

    checkpoint: str
    checks: list[Check]


def suffix(suite: Suite) -> str:
    """Return the end of the names of files with results of a suite."""
    return f".{suite}.json"


def path_beside(checkpoint: Path, suite: Suite) -> Path:
    """Return the path of a suite's results on a checkpoint's file."""
    return checkpoint.with_name(f"{checkpoint.stem}{suffix(suite)}")


def checksum(checkpoint: Path) -> str:
    """Return the SHA-256 of a checkpoint's file."""
    return sha256(checkpoint.read_bytes()).hexdigest()


def write(path: Path, verdict: Verdict) -> None:
    """Write results to a file, atomically and with a checksum."""
    sealed.write(path, asdict(verdict))  # type: ignore[call-overload]


def read(path: Path) -> Verdict:
    """Read results from a file.

    Raises:
        SealError: the file is damaged, or holds something else; the message names it.
        OSError: the file cannot be read.
    """
    advice = f"delete it, and run `python -m gpe_pl.benchmark suite={path.suffixes[-2].removeprefix('.')}` again"
    values = sealed.read(path, advice)
    try:
        return TypeAdapter(Verdict).validate_json(json.dumps(values))
    except ValidationError as error:
        fault = error.errors()[0]
        raise sealed.SealError(f"{path}: {'.'.join(map(str, fault['loc']))}: {fault['msg']}; {advice}") from None


def added(path: Path, verdict: Verdict, measured: Collection[str]) -> Verdict:
    """Return a verdict with the checks of an earlier one on the same checkpoint that were not measured again, in the order of their names' numbers.

    Args:
        path: file of the earlier verdict; it may be missing.
        verdict: the new verdict.
        measured: names of all checks that were measured now, also of those that did not apply.

    Raises:
        SealError: the file is damaged.
    """
    if not path.exists() or (before := read(path)).checkpoint != verdict.checkpoint:
        return verdict
    kept = [check for check in before.checks if check.name not in measured]
    return Verdict(verdict.checkpoint, sorted([*verdict.checks, *kept], key=lambda check: int(check.name.partition(" ")[0])))


def headline(checkpoint: Path | str) -> str:
    """Return the line with which model cards and ``evaluate`` begin. It names the failed checks of the acceptance scenes, then the failed stress tests.

    If there are no results of acceptance scenes, the line says so. If there are none of stress tests, it does not mention them.

    Args:
        checkpoint: path of a checkpoint, folder of a run, or name of a shipped model.
    """
    own = checkpoint_path(checkpoint)
    accepted = _of_suite(own, "acceptance", NOT_MEASURED, _acceptance)
    tested = _of_suite(own, "stability", NOT_TESTED, _stress_tests) if path_beside(own, "stability").exists() else ""
    return one_line(". ".join(filter(None, [accepted, tested and tested[0].upper() + tested[1:]])))


def _of_suite(own: Path, suite: Suite, unknown: str, sentence: Callable[[Sequence[Check]], str]) -> str:
    """Return the sentence on the checks of a suite, or why there is none."""
    path = path_beside(own, suite)
    try:
        verdict = read(path)
        is_own = verdict.checkpoint == checksum(own)
    except FileNotFoundError:
        return unknown
    except (sealed.SealError, OSError) as error:
        return f"{unknown}: {error}"
    return sentence(verdict.checks) if is_own else f"{unknown}: {path} is of another checkpoint"


def _acceptance(checks: Sequence[Check]) -> str:
    failed = [f"{check.name} {check.measured}" for check in checks if not check.passed]
    if not failed:
        return f"passes acceptance: {len(checks)} of {len(checks)} checks"
    return f"fails acceptance in {len(failed)} of {len(checks)} checks: {'; '.join(failed)}"


def _stress_tests(checks: Sequence[Check]) -> str:
    """Name failed tests by number and name only, because what they measure takes a line each."""
    failed = [check.name for check in checks if not check.passed]
    if not failed:
        return f"passes {len(checks)} of {len(checks)} stress tests"
    return f"fails {len(failed)} of {len(checks)} stress tests: {'; '.join(failed)}"

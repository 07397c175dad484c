"""Results of the acceptance scenes of a checkpoint, stored beside it as ``{stem}.acceptance.json``.

The file holds the checksum of the checkpoint, so results of another checkpoint are never shown. It is plain JSON with typed values, and nothing in it is loaded
as code.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gpe_pl.files import sealed
from gpe_pl.learned.pretrained import checkpoint_path
from gpe_pl.printable import one_line

SUFFIX = ".acceptance.json"
NOT_MEASURED = "acceptance not measured"


@dataclass(frozen=True, config={"extra": "forbid", "strict": True})
class Check:
    """Result of one check.

    Attributes:
        name: scene and quantity.
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
class Acceptance:
    """All checks of a checkpoint.

    Attributes:
        checkpoint: SHA-256 of the checkpoint's file.
        checks: results in the order of the scenes.
    """

    checkpoint: str
    checks: list[Check]

    def headline(self) -> str:
        """Return one line that names what fails."""
        failed = [check for check in self.checks if not check.passed]
        if not failed:
            return f"passes acceptance: {len(self.checks)} of {len(self.checks)} checks"
        parts = "; ".join(f"{check.name} {check.measured}" for check in failed)
        return one_line(f"fails acceptance in {len(failed)} of {len(self.checks)} checks: {parts}")


def path_beside(checkpoint: Path) -> Path:
    """Return the path of the results of a checkpoint's file."""
    return checkpoint.with_name(f"{checkpoint.stem}{SUFFIX}")


def checksum(checkpoint: Path) -> str:
    """Return the SHA-256 of a checkpoint's file."""
    return sha256(checkpoint.read_bytes()).hexdigest()


def write(path: Path, acceptance: Acceptance) -> None:
    """Write results to a file, atomically and with a checksum."""
    sealed.write(path, asdict(acceptance))  # type: ignore[call-overload]


def read(path: Path) -> Acceptance:
    """Read results from a file.

    Raises:
        SealError: the file is damaged, or holds something else; the message names it.
        OSError: the file cannot be read.
    """
    advice = "delete it, and run `python -m gpe_pl.benchmark suite=acceptance` again"
    values = sealed.read(path, advice)
    try:
        return TypeAdapter(Acceptance).validate_json(json.dumps(values))
    except ValidationError as error:
        fault = error.errors()[0]
        raise sealed.SealError(f"{path}: {'.'.join(map(str, fault['loc']))}: {fault['msg']}; {advice}") from None


def headline(checkpoint: Path | str) -> str:
    """Return the line with which model cards and ``evaluate`` begin. It says what fails, that everything passes, or that nothing was measured.

    Args:
        checkpoint: path of a checkpoint, folder of a run, or name of a shipped model.
    """
    own = checkpoint_path(checkpoint)
    path = path_beside(own)
    try:
        acceptance = read(path)
        is_own = acceptance.checkpoint == checksum(own)
    except FileNotFoundError:
        return NOT_MEASURED
    except (sealed.SealError, OSError) as error:
        return one_line(f"{NOT_MEASURED}: {error}")
    return acceptance.headline() if is_own else one_line(f"{NOT_MEASURED}: {path} is of another checkpoint")

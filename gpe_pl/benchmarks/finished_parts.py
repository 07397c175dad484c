"""Finished parts of a suite, each stored in a file of its own, so that a stopped suite continues where it was."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gpe_pl.files import sealed
from gpe_pl.system.machine import commit

PARTS = "parts"
"""Subfolder of a suite's results for the files of finished parts."""
PACKAGE = Path(__file__).resolve().parents[1]
"""Folder of the running code."""
ADVICE = "delete it; the part is then measured again"


@cache
def _code() -> str:
    """Return the commit of the running code, with a digest of its files where the commit does not determine them."""
    name = commit()
    if name != "unknown" and not name.endswith("-dirty"):
        return name
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return f"{name} {digest.hexdigest()[:16]}"


@dataclass(frozen=True)
class FinishedParts:
    """Records of finished parts of a suite, such as one scene or one test. Several processes may store different parts at once.

    The identity of a part is given by the suite and contains everything that the records depend on. The commit of the running code is added to it. Files of
    another identity are never used; ``clear`` deletes them.

    Attributes:
        folder: folder of the files, which nothing else uses.
    """

    folder: Path

    def get(self, identity: dict[str, Any]) -> list[dict[str, Any]] | None:
        """Return the records of a part, or None if it has not finished.

        Raises:
            SealError: the file is damaged.
        """
        path, known = self._place(identity)
        if not path.exists():
            return None
        values = sealed.read(path, ADVICE)
        return list(values["records"]) if values.get("identity") == known else None

    def put(self, identity: dict[str, Any], records: list[dict[str, Any]]) -> None:
        """Store the records of a part.

        Raises:
            ValueError: a number is not finite.
        """
        path, known = self._place(identity)
        self.folder.mkdir(parents=True, exist_ok=True)
        sealed.write(path, {"identity": known, "records": records})

    def clear(self) -> None:
        """Delete all files, so that the next run measures everything again."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _place(self, identity: dict[str, Any]) -> tuple[Path, dict[str, Any]]:
        known = json.loads(json.dumps({**identity, "code": _code()}, allow_nan=False))
        return self.folder / f"{sealed.checksum(known)[:16]}.json", known

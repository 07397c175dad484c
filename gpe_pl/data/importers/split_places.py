"""Places of the splits of a data set: a file or a folder for each."""

from __future__ import annotations

from collections.abc import Sequence, Set
from pathlib import Path

from gpe_pl.data.importers.source import ImportFailure, natural

SPLIT_NAMES = {"train": "train", "valid": "val", "validation": "val", "val": "val", "test": "test", "test_unseen": "test_unseen"}
"""Names of splits in the store, by their names in public data sets."""


def split_files(path: Path, endings: tuple[str, ...]) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the files ``train``, ``valid``, ``test`` … with one of the endings in a folder, by split, and a warning of other such files.

    If ``path`` is a file, it belongs to the split of its name, or to ``train`` if its name is not that of a split.

    Raises:
        ImportFailure: there is no such file, or a split has two.
    """
    if path.is_file():
        return {SPLIT_NAMES.get(path.name.partition(".")[0], "train"): path}, ()
    there = [(split, path / f"{name}{ending}") for name, split in SPLIT_NAMES.items() for ending in endings]
    found = _one_each(path, [(split, file) for split, file in there if file.is_file()])
    if not found:
        wanted = " or ".join(f"train{ending}" for ending in endings)
        raise ImportFailure(f"{path}: {'no such file or folder' if not path.exists() else f'holds no {wanted}'}")
    others = _loose(path, endings, {file.name for file in found.values()})
    warnings = (
        (f"{len(others)} other files were not read, the first is {others[0]}: splits are {', '.join(SPLIT_NAMES)}",) if others else ()
    )
    return found, warnings


def split_folders(path: Path, *endings: str) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the folders ``train``, ``valid``, ``test`` … in a folder, by split (``SPLIT_NAMES``), and warnings of what is beside them.

    There is a warning for each other folder, and one for files with one of the endings. Without any folder of a split there are no warnings.

    Raises:
        ImportFailure: a split has two folders.
    """
    if not path.is_dir():
        return {}, ()
    folders = {entry.name: entry for entry in path.iterdir() if entry.is_dir() and not entry.name.startswith(".")}
    found = _one_each(path, [(split, folders[name]) for name, split in SPLIT_NAMES.items() if name in folders])
    others = sorted({*folders} - {*SPLIT_NAMES})
    warnings = [f"{name}/ was not read: splits are {', '.join(SPLIT_NAMES)}" for name in others]
    if loose := _loose(path, endings):
        folder = next(iter(found.values())).name if found else ""
        warnings.append(f"{len(loose)} files beside {folder}/ were not read, the first is {loose[0]}: move them into the folder of a split")
    return found, tuple(warnings) if found else ()


def _loose(path: Path, endings: tuple[str, ...], read: Set[str] = frozenset()) -> list[str]:
    names = {entry.name for entry in path.iterdir() if entry.is_file() and entry.name.endswith(endings)}
    return sorted((name for name in names - read if not name.startswith(".")), key=natural)


def _one_each(path: Path, found: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """Return the place of each split; raises ``ImportFailure`` if a split has two places."""
    places: dict[str, Path] = {}
    for split, place in found:
        if split in places:
            raise ImportFailure(f"{path}: {places[split].name} and {place.name} are both the split {split}; move one of them elsewhere")
        places[split] = place
    return places

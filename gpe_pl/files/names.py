"""Checks of the names of runs, sweeps and data sets, which become folder names."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator

from gpe_pl.errors import GpeError

MOST_BYTES = 200
"""Longest name that a user may choose [bytes]. File systems allow 255, but the names of locks and temporary files are longer than the name itself."""
MOST_BYTES_OF_VALUES = 255
"""Longest part of a path that is made of overrides [bytes]; the limit of file systems."""
FORBIDDEN = frozenset('<>:"|?*\\')
"""Characters that Windows does not allow in names."""
RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{k}" for port in ("com", "lpt") for k in range(1, 10))}
"""Device names of Windows, which are reserved with any suffix."""
PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.-")
"""Characters of data set names."""


class NameRefused(GpeError, ValueError):
    """Raised for a name that cannot be a folder's name; the message names the key and the reason."""


def run_name(name: Any, key: str = "name") -> str:
    """Check and return the name of a run in the results folder; ``/`` separates folders, as in ``sweep/first``.

    Raises:
        NameRefused: the name is not text, or one of its parts is empty, begins with a dot, has more than ``MOST_BYTES``, or is not allowed on some operating
            system.
    """
    faults = ["must be the name of a folder for the results"] if not isinstance(name, str) else map(_fault, name.split("/"))
    for fault in filter(None, faults):
        raise NameRefused(f"{key}={_quoted(name)}: {fault}")
    return str(name)


def data_name(name: Any, key: str = "name") -> str:
    """Check and return the name of a data set: ASCII letters, digits, ``_``, ``-`` and ``.``, starting with a letter or digit.

    Raises:
        NameRefused: the name breaks this rule, has more than ``MOST_BYTES``, or is not allowed on some operating system.
    """
    try:
        return _plain(name)
    except ValueError as fault:
        raise NameRefused(f"{key}={_quoted(name)}: {fault}") from None


def _plain(name: Any) -> str:
    if not isinstance(name, str) or not name or set(name) - PLAIN or name[0] in "_.-":
        raise ValueError("must be a folder's name of letters, digits, '_', '-' and '.', a letter or digit first")
    if fault := _fault(name):
        raise ValueError(fault)
    return name


DataName = Annotated[str, AfterValidator(_plain)]
"""Type of a setting that is the name of a data set; pydantic checks it as ``data_name`` does."""


def sweep_name(overrides: str) -> str:
    """Return the folder of a sweep's run, relative to the sweep's folder, named by the run's overrides.

    A ``/`` in a value separates folders. Other characters that are not allowed everywhere are encoded by ``portable``.

    Raises:
        NameRefused: the path leads out of the sweep's folder, or a part of it is not printable or longer than file systems allow.
    """
    parts = overrides.lstrip("/").split("/")
    for part in parts:
        if part == "..":
            raise NameRefused(
                f"{_quoted(overrides)}: the run's folder is named by its overrides, and /../ leads out of it; give a path without"
            )
        if not part.isprintable() or len(portable(part).encode()) > MOST_BYTES_OF_VALUES:
            raise NameRefused(
                f"{_quoted(part)}: the run's folder is named by its overrides, which must be printable and have at most {MOST_BYTES_OF_VALUES} bytes each"
            )
    return "/".join(map(portable, parts))


def portable(part: str) -> str:
    """Return a part of a path as a name that Windows allows. Different parts stay different.

    Forbidden characters, ``~``, a dot or space at the end and the first letter of a device name become ``~`` and two hexadecimal digits.
    """
    text = "".join(_coded(letter) if letter in FORBIDDEN or letter == "~" else letter for letter in part)
    if text.endswith((".", " ")):
        text = f"{text[:-1]}{_coded(text[-1])}"
    return f"{_coded(text[0])}{text[1:]}" if _is_device(text) else text


def _coded(letter: str) -> str:
    return f"~{ord(letter):02X}"


def _fault(part: str) -> str | None:
    """Return why a part of a path cannot be a folder's name on every system, or None if it can."""
    if not part.strip():
        return "must be the name of a folder, not empty"
    if part[0] == ".":
        return "must not begin with a dot, nor lead outside the folder of the results"
    if not part.isprintable():
        return "contains characters that are not printable; remove them"
    if len(part.encode()) > MOST_BYTES:
        return f"has {len(part.encode())} bytes; the name of a folder has at most {MOST_BYTES}"
    if forbidden := FORBIDDEN.intersection(part):
        return f"holds {' '.join(sorted(forbidden))}, which not every system allows in the name of a folder"
    if part[-1] in ". " or part[0] == " ":
        return "must not end in a dot, nor begin or end with a space"
    if _is_device(part):
        return "is a device of Windows; choose another name"
    return None


def _is_device(part: str) -> bool:
    return part.partition(".")[0].lower() in RESERVED


def _quoted(name: Any, most: int = 100) -> str:
    text = repr(name)
    return text if len(text) <= most else f"{text[:most]}…"


def spacing_suffix(factor: float | int) -> str:
    """Return what the name of a data set with another ``data.spacing_factor`` ends with."""
    return "" if factor == 1 else f"_spacing_{factor:g}"

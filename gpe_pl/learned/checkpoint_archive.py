"""Checks of PyTorch archives from unknown sources, made before their pickle is read.

PyTorch's safe loading (``weights_only=True``) runs no code. A few bytes in a file can still make it use gigabytes of memory or run for hours. Such files have
members that unpack to far more than is stored, members that overlap in the file, arrays that claim more values than are stored, or nested tuples as keys.
"""

from __future__ import annotations

import pickletools
import re
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from gpe_pl.files.zip_members import num_members

MOST_MEMBERS = 2**16
"""Maximum number of members. There is one per tensor; the largest run has some thousands."""
MOST_PICKLE_BYTES = 2**24
MOST_VALUES, MOST_LEVELS = 2**20, 32
"""Maximum number of values in a checkpoint, and of levels of nesting. A value that is referred to in several places counts each time."""
MOST_TUPLES = 16
"""Maximum number of levels of nested tuples; tensors have five."""

CALLED = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"}
NAMED = re.compile(r"torch \w+Storage")
OPCODES = {
    *("PROTO", "STOP", "MARK", "POP", "POP_MARK", "GLOBAL", "REDUCE", "BUILD"),
    *("BINPERSID", "BINGET", "LONG_BINGET", "BINPUT", "LONG_BINPUT"),
    *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE"),
    *("SHORT_BINSTRING", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
    *("EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS"),
}
"""Opcodes that ``torch.save`` writes, which uses protocol 2."""
_MARK = (-1, "")


def check_archive(path: Path, check: Callable[[bytes], None] | None = None) -> None:
    """Check that an archive has the structure that ``torch.save`` writes, and that its checksums match.

    Args:
        path: the archive.
        check: checks the pickle, and raises ``ValueError``; None takes ``check_pickle``.

    Raises:
        ValueError: the archive has other contents; the message names them.
        OSError, zipfile.BadZipFile: the file is damaged, or not an archive.
    """
    if (count := num_members(path)) > MOST_MEMBERS:
        raise ValueError(f"{count} members, at most {MOST_MEMBERS} are read")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        packed = [
            member.filename for member in members if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size
        ]
        if packed:
            raise ValueError(f"{packed[0]} is compressed, which PyTorch never does")
        if sum(member.file_size for member in members) > path.stat().st_size:
            raise ValueError("its members share their bytes")
        if (damaged := archive.testzip()) is not None:
            raise zipfile.BadZipFile(f"checksum mismatch in {damaged}")
        for member in members:
            if member.filename.endswith("data.pkl"):
                if member.file_size > MOST_PICKLE_BYTES:
                    raise ValueError(f"{member.file_size} bytes beside its tensors, at most {MOST_PICKLE_BYTES} are read")
                (check or check_pickle)(archive.read(member))


def check_pickle(content: bytes) -> None:
    """Interpret a pickle as far as needed to find the functions that it calls and the depth of its tuples.

    Raises:
        ValueError: the pickle has an opcode, a function or deeper tuples than tensors need, or is damaged; the message names it.
    """
    stack: list[tuple[int, str]] = []  # levels of tuples in each value, and its name where it is a global
    memo: dict[int, tuple[int, str]] = {}
    argument: Any
    try:
        for opcode, argument, _ in pickletools.genops(content):
            name = opcode.name
            if name not in OPCODES:
                raise ValueError(f"a pickle with {name}")
            if name in ("BINPUT", "LONG_BINPUT"):
                memo[argument] = stack[-1]
            elif name in ("BINGET", "LONG_BINGET"):
                stack.append(memo[argument])
            elif name == "GLOBAL":
                if argument not in CALLED and not NAMED.fullmatch(argument):
                    raise ValueError(f"a pickle with {argument[:100]}")
                stack.append((0, argument))
            else:
                _apply(opcode, stack)
    except (IndexError, KeyError):
        raise ValueError("a pickle that is damaged") from None


def _apply(opcode: pickletools.OpcodeInfo, stack: list[tuple[int, str]]) -> None:
    """Apply the effect of an opcode to the stack."""
    taken: list[tuple[int, str]] = []
    for kind in reversed(opcode.stack_before):
        if kind is pickletools.stackslice:
            while (top := stack.pop()) is not _MARK:
                taken.append(top)
        elif kind is not pickletools.markobject:  # the slice above has removed the mark
            taken.append(stack.pop())
    if opcode.name == "REDUCE" and taken[-1][1] not in CALLED:
        raise ValueError(f"a pickle that calls {taken[-1][1][:100] or 'something'}")
    depth = max((levels for levels, _ in taken), default=0) + opcode.name.startswith("TUPLE")
    if depth > MOST_TUPLES:
        raise ValueError(f"tuples nested more than {MOST_TUPLES} levels deep")
    if opcode.name == "MARK":
        stack.append(_MARK)
    else:
        stack += [(depth, "") for _ in opcode.stack_after]


def check_values(values: Any) -> None:
    """Check values that were read against limits on number and depth.

    Raises:
        ValueError: there are too many values, they are nested too deeply, or a tensor has fewer values than its shape says.
    """
    count, level = 0, [values]
    for _ in range(MOST_LEVELS):
        count += len(level)
        inside: list[Any] = []
        for value in level:
            if isinstance(value, torch.Tensor):
                if value.untyped_storage().nbytes() < value.numel() * value.element_size():
                    raise ValueError(f"a tensor {list(value.shape)} has fewer values than its shape says")
            elif isinstance(value, dict | list | tuple):
                if count + len(inside) + len(value) > MOST_VALUES:
                    raise ValueError(f"more than {MOST_VALUES} values")
                inside += _inside(value)
        if not inside:
            return
        level = inside
    raise ValueError(f"values nested more than {MOST_LEVELS} levels deep")


def _inside(value: dict[Any, Any] | list[Any] | tuple[Any, ...]) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value

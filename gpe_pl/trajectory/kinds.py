"""Kinds of fields of states and boundaries. A field declares its kind once, as metadata of the dataclass field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

Kind = Mapping[str, str]

NODE: Kind = {"kind": "node"}
"""A row per node."""
CELL: Kind = {"kind": "cell"}
"""A row per mesh cell that holds numbers of nodes."""
SCENE: Kind = {"kind": "scene"}
"""One value for the whole scene."""
STEP: Kind = {"kind": "step"}
"""What a simulator computed in the step that led to a state, and what it needs for the next one. Needs a default, which says that nothing is known."""


def names_of(part: Any, kind: Kind) -> tuple[str, ...]:
    """Return the names of the fields of a kind, in the order of their declaration; ``part`` is a dataclass or an instance of one."""
    return tuple(field.name for field in fields(part) if field.metadata == kind)

"""Kinds of fields of states and boundaries. A field declares its kind once, as metadata of the dataclass field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

Kind = Mapping[str, str]

NODE: Kind = {"kind": "node"}
"""The field has one row per node."""
CELL: Kind = {"kind": "cell"}
"""The field has one row per mesh cell. Its values are numbers of nodes."""
GROUP: Kind = {"kind": "group"}
"""The field has one row per node. Its values are numbers of groups of nodes, −1 for none."""
SCENE: Kind = {"kind": "scene"}
"""The field has one value for the whole scene."""
PARTS: Kind = {"kind": "parts"}
"""The field is an object with values of nodes and of later frames, such as ``loads.Loads``. It has ``take``, ``joined`` and ``at`` of its own."""
STEP: Kind = {"kind": "step"}
"""The field describes the step that led to a state, or is memory of a simulator for its next step. It needs a default value, which means unknown."""


def names_of(part: Any, kind: Kind) -> tuple[str, ...]:
    """Return the names of the fields of a kind, in the order of their declaration; ``part`` is a dataclass or an instance of one."""
    return tuple(field.name for field in fields(part) if field.metadata == kind)

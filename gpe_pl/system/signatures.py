"""Values from files and command lines, checked against the annotated signature of what takes them: types, ranges, choices, names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, get_type_hints

from pydantic import ConfigDict, create_model

MOST_VALUES, MOST_LEVELS, LONGEST_TEXT, LARGEST_NUMBER = 20_000, 20, 10_000, 2**64
"""Of plain values from a file; the largest description of a model has some hundreds."""


def check_plain(values: Any) -> None:
    """Compare values from a file with limits before anything else, a message included, goes through them.

    A value that is referred to in several places counts in each: a file of a kilobyte can hold lists of lists that nobody could ever print.

    Raises:
        ValueError: too many values, too deeply nested, too long or too large; or something else than text, numbers, lists, tables and None.
    """
    count, waiting = 0, [(values, 0)]
    while waiting:
        value, level = waiting.pop()
        count += 1
        if isinstance(value, str):
            if len(value) > LONGEST_TEXT:
                raise ValueError(f"a text of {len(value)} characters, more than {LONGEST_TEXT}")
        elif isinstance(value, (dict, list, tuple)):
            inside = [each for pair in value.items() for each in pair] if isinstance(value, dict) else value
            if level == MOST_LEVELS:
                raise ValueError(f"values nested more than {MOST_LEVELS} levels deep")
            if count + len(waiting) + len(inside) > MOST_VALUES:
                raise ValueError(f"more than {MOST_VALUES} values")
            waiting += [(each, level + 1) for each in inside]
        elif isinstance(value, int):
            if abs(value) >= LARGEST_NUMBER:
                raise ValueError("an integer beyond 64 bits")
        elif not isinstance(value, (float, type(None))):
            raise ValueError(f"a {type(value).__name__}, where only text, numbers, lists and tables are")


def parameters(target: Callable[..., Any], *later: str) -> dict[str, Any]:
    """Annotation and default of each parameter of a class or function, but those that come later."""
    annotated = target.__init__ if inspect.isclass(target) and not is_dataclass(target) else target
    hints = get_type_hints(annotated, include_extras=True)
    return {
        name: (hints.get(name, Any), ... if parameter.default is inspect.Parameter.empty else parameter.default)
        for name, parameter in inspect.signature(target).parameters.items()
        if name not in later
    }


def checked(target: Callable[..., Any], values: Mapping[str, Any], *later: str) -> dict[str, Any]:
    """The values as the target takes them; ``later`` are parameters that are not among them.

    Raises:
        pydantic.ValidationError: an unknown or missing name, another type, or a value out of range.
    """
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, protected_namespaces=(), allow_inf_nan=False)
    found = create_model("Settings", __config__=config, **parameters(target, *later))(**values)
    return {name: getattr(found, name) for name in found.model_fields_set}

"""Checks of values from files and command lines against the annotated signature of their target: types, ranges, choices and names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from functools import cache
from typing import Any, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model

MOST_VALUES, MOST_LEVELS, LONGEST_TEXT, LARGEST_NUMBER = 20_000, 20, 10_000, 2**64
"""Limits for plain values from a file. The largest description of a model has some hundreds of values."""


def check_plain(values: Any) -> None:
    """Check limits on values from a file before anything else, such as a message, visits them.

    A value that is referenced in several places counts each time. A file of a kilobyte can contain nested references that are too large to print.

    Raises:
        ValueError: there are too many values, or one is too deeply nested, too long or too large, or is not text, a number, a list, a table or None.
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
            raise ValueError(f"a {type(value).__name__}, only text, numbers, lists and tables are allowed")


def parameters(target: Callable[..., Any], *later: str) -> dict[str, Any]:
    """Return annotation and default of each parameter of a class or function, except those named in ``later``. ``...`` stands for no default."""
    annotated = target.__init__ if inspect.isclass(target) and not is_dataclass(target) else target
    hints = get_type_hints(annotated, include_extras=True)
    return {
        name: (hints.get(name, Any), ... if parameter.default is inspect.Parameter.empty else parameter.default)
        for name, parameter in inspect.signature(target).parameters.items()
        if name not in later
    }


def checked(target: Callable[..., Any], values: Mapping[str, Any], *later: str) -> dict[str, Any]:
    """Validate values for a target and convert them to its annotated types.

    Args:
        target: class or function that takes the values.
        values: values by parameter name.
        later: parameters that are passed separately and are not among the values.

    Raises:
        pydantic.ValidationError: a name is unknown or missing, a type is wrong, or a value is out of range or not finite.
    """
    found = _model(target, *later)(**values)
    return {name: getattr(found, name) for name in found.model_fields_set}


@cache
def _model(target: Callable[..., Any], *later: str) -> type[BaseModel]:
    """Return the model of the values of a target; Pydantic takes milliseconds to make one."""
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, protected_namespaces=(), allow_inf_nan=False)
    return create_model("Settings", __config__=config, **parameters(target, *later))

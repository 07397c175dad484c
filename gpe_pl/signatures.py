"""Values from files and command lines, checked against the annotated signature of what takes them: types, ranges, choices, names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, get_type_hints

from pydantic import ConfigDict, create_model


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

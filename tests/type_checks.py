"""Checks of types and shapes at run time, which pytest loads by ``-p tests.type_checks``.

``--jaxtyping-packages`` decorates every function of the package with ``jaxtyping.jaxtyped``. For each function this makes two further functions with checked
arguments, and each call binds its arguments once more and checks them twice. This takes a third of the time of the tests. The decorator here checks arguments
and result once. Only functions with a shape in their annotations get a scope for the names of lengths. The check of a function is made at its first call.
Functions within functions are not checked, because each call of the outer function would make their checks again.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from functools import partial, wraps
from types import FunctionType
from typing import Any, get_args, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

typed = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))
"""Decorator that checks types."""
whole = jaxtyping.jaxtyped
"""Decorator of jaxtyping, which also names lengths in messages."""


def checked(thing: Any = None, *, typechecker: Callable[[Any], Any]) -> Any:
    """Decorate a function or a dataclass like ``jaxtyping.jaxtyped``."""
    if thing is None:
        return partial(checked, typechecker=typechecker)
    if inspect.isclass(thing):
        if dataclasses.is_dataclass(thing) and not hasattr(thing.__init__, "__wrapped__"):
            thing.__init__ = checked(thing.__init__, typechecker=typechecker)  # type: ignore[method-assign]
        return thing
    if "<locals>" in thing.__qualname__:
        return thing
    if not isinstance(thing, FunctionType) or inspect.isgeneratorfunction(thing):
        return whole(thing, typechecker=typechecker)
    return _checked_function(thing, typechecker)


def _checked_function(function: FunctionType, typechecker: Callable[[Any], Any]) -> Callable[..., Any]:
    known = _known_annotations(function)
    if not known:
        return function
    checking: Callable[..., Any] | None = None

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checking
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        if checking is None:
            checking = _checking(function, known, typechecker)
        return checking(*args, **kwargs)

    return called


def _checking(function: FunctionType, known: dict[str, Any], typechecker: Callable[[Any], Any]) -> Callable[..., Any]:
    """Return the function with checks of these annotations."""
    written, function.__annotations__ = function.__annotations__, known
    try:
        checking = typechecker(function)
    finally:
        function.__annotations__ = written
    return whole(checking, typechecker=None) if any(map(_has_shape, known.values())) else checking


def _known_annotations(function: FunctionType) -> dict[str, Any]:
    """Return the types of arguments and result, without those that only type checkers import."""
    known: dict[str, Any] = {}
    for name, annotation in function.__annotations__.items():

        def alone() -> None: ...

        alone.__annotations__ = {name: annotation}
        try:
            known |= get_type_hints(alone, function.__globals__, include_extras=True)
        except Exception:  # names that are not there yet, or shapes that only a reader understands
            continue
    return known


def _has_shape(annotation: Any) -> bool:
    if isinstance(annotation, list | tuple):  # arguments of a callable
        return any(map(_has_shape, annotation))
    return (inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray)) or any(map(_has_shape, get_args(annotation)))


jaxtyping.jaxtyped = checked  # type: ignore[assignment]

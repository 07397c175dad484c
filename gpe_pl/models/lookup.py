"""Lookup of model classes by dotted name: those of this package, and those that installed packages register.

A package registers a class under the entry point group ``gpe_pl.models``, by the module that defines it::

    [project.entry-points."gpe_pl.models"]
    net = "mypackage.net:Net"

Names come from files, so nothing else is ever imported.
"""

from __future__ import annotations

import importlib
import inspect
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gpe_pl.errors import GpeError
from gpe_pl.models.base import Model

PACKAGE = "gpe_pl.models"
"""Package of models, and name of the entry point group."""


class UnknownModelError(GpeError, ValueError):
    """Raised for a dotted name that is not a model of this package or of an installed package."""


def model_class(target: Any) -> type[Model]:
    """Return the model class of a dotted name, such as ``gpe_pl.models.gpe.GPE`` or ``mypackage.net.Net``.

    Raises:
        UnknownModelError: any other name, or a registered class that cannot be imported or is no model.
    """
    module, _, name = str(target).rpartition(".")
    registered = None if module.startswith(f"{PACKAGE}.") else _registered(module, name)
    try:
        cls = getattr(importlib.import_module(module), name) if registered is None else registered.load()
    except (ImportError, AttributeError) as error:
        where = "in this version of gpe_pl" if registered is None else f"in {_package(registered)} ({error})"
        raise UnknownModelError(f"model {target!r} does not exist {where}") from None
    except Exception as error:  # a package of others raises anything while it is imported
        raise UnknownModelError(f"model {target!r} of {module} cannot be imported: {type(error).__name__}: {error}") from None
    if not (inspect.isclass(cls) and issubclass(cls, Model)) or inspect.isabstract(cls):
        raise UnknownModelError(f"{target!r} is not a model: it must be a subclass of gpe_pl.models.base.Model with all its methods")
    if (cls.__module__, cls.__qualname__) != (module, name):
        raise UnknownModelError(f"{target!r} is defined elsewhere: name it {cls.__module__}.{cls.__qualname__}")
    return cls


def _registered(module: str, name: str) -> EntryPoint:
    """Return the entry point of a name, without importing anything."""
    found = entry_points(group=PACKAGE)
    for entry in found:
        if entry.value.replace(" ", "") == f"{module}:{name}":
            return entry
    known = f" ({', '.join(sorted({entry.value.replace(':', '.') for entry in found}))})" if found else ""
    what = f"model {f'{module}.{name}'.lstrip('.')[:200]!r} is not one of {PACKAGE}, nor one that an installed package registers{known}"
    raise UnknownModelError(f"{what}; install the package that has it")


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist else "an installed package"

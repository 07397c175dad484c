"""Values that a command gives for an import: merged with those of a source, and which of them have no effect."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from gpe_pl.schema import MATERIALS


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters by material; values of the second mapping have precedence, parameter by parameter."""
    both: dict[str, Any] = {**first, **second}
    for material in first.keys() & second.keys() & MATERIALS.keys():
        both[material] = {**_by_name(material, first[material]), **_by_name(material, second[material])}
    return both


def replaced(given: Mapping[str, Any], own: Mapping[str, Any]) -> Iterator[str]:
    """Yield a note for each given parameter that a trajectory of the source has itself; both mappings are parameters by material."""
    for material in (name for name in MATERIALS if name in given and name in own):
        values = _by_name(material, own[material])
        for name in (name for name in _by_name(material, given[material]) if name in values):
            yield f"{name} of {material} is that of the source; parameters={{{material}: …}} counts only where the source has none"


def without_effect(settings: Mapping[str, Any], materials: Collection[str], types: Collection[int]) -> Iterator[str]:
    """Yield a warning for each given parameter or node type that no trajectory has.

    Args:
        settings: settings of the import that are given, by name.
        materials: materials of all trajectories.
        types: node types of the source that occur in trajectories.
    """
    for material in settings.get("parameters", {}):
        if material not in materials:
            yield f"parameters={{{material}: …}} has no effect: no node is {material}, materials are {', '.join(sorted(materials))}"
    for code, material in settings.get("materials", {}).items():
        if code not in types:
            yield f"materials={{{code}: {material}}} has no effect: no node has type {code}, types are {', '.join(map(str, sorted(types)))}"


def _by_name(material: str, values: Any) -> Mapping[str, Any]:
    return values if isinstance(values, Mapping) else {MATERIALS[material][0].name: values}

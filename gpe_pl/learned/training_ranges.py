"""Comparison of a scene's material parameters and masses with their ranges in training."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from torch import Tensor

from gpe_pl.schema import MaterialParameter, node_code, param_names
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

RANGE_TOLERANCE = 1e-5
"""Relative difference of material parameters that counts as none, because they are stored in single precision."""
MASS_FACTOR = 2.0
"""Factor by which masses of nodes may leave the range of training: corners of meshes differ between bodies of one kind."""


def stored_ranges(metadata: Metadata, material: str, trained: Tensor) -> Iterator[tuple[MaterialParameter, int, Tensor]]:
    """Yield each stored parameter of a material with its column of ``material_params`` and its trained range [2].

    Args:
        metadata: metadata of the training data.
        material: name of the material.
        trained: lowest and highest value [2, param] of its parameters in training.
    """
    yield from zip(metadata.parameters_of(material), metadata.columns_of(material), trained.T, strict=True)


def outside_parameters(state: State, metadata: Metadata, ranges: Iterable[tuple[str, Tensor]]) -> Iterator[tuple[str, str]]:
    """Yield the kind of each material parameter of a scene that is outside the range of training, and a line that says so.

    Args:
        state: state of the scene, as tensors.
        metadata: metadata of the training data.
        ranges: each material with the range [2, param] of its parameters in training.
    """
    for material, trained in ranges:
        of_material = state.node_type == node_code(material)
        for spec, column, (low, high) in stored_ranges(metadata, material, trained):
            values = state.material_params[of_material, column]
            is_outside = (values < low - RANGE_TOLERANCE * low.abs()) | (values > high + RANGE_TOLERANCE * high.abs())
            if bool(is_outside.any()):
                kind = f"{spec.name} of {material}"
                yield kind, f"{kind} is {spec.quantity(values[is_outside][0].item())}, trained were {low.item():g} to {high.item():g}"


def outside_masses(state: State, materials: Sequence[str], trained: Tensor) -> Iterator[tuple[str, str]]:
    """Yield the kind of each mass of a scene that is outside the range of training by more than ``MASS_FACTOR``, and a line that says so.

    Args:
        state: state of the scene, as tensors.
        materials: materials of the training data.
        trained: lowest and highest mass [2, material] of a node in training [kg].
    """
    for material, (low, high) in zip(materials, trained.T.tolist(), strict=True):
        mass = state.mass[state.node_type == node_code(material)]
        is_outside = (mass < low / MASS_FACTOR) | (mass > high * MASS_FACTOR)
        if bool(is_outside.any()):
            kind = f"mass of nodes of {material}"
            yield kind, f"{kind} is {mass[is_outside][0].item():g} kg, in training it was {low:g} to {high:g} kg"


def named_materials(metadata: Metadata) -> str:
    """Return the materials, the parameters that the data set stores besides the first of each, and its loads."""
    further = sorted(set(metadata.param_names) - set(param_names(metadata.materials)))
    given = [{"motion": "prescribed nodes", "force": "nodal forces"}[name] for name in metadata.loads or ()]
    return ", ".join(metadata.materials) + (f" with {', '.join((*further, *given))}" if (further or given) else "")

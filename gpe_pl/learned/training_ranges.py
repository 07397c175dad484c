"""Comparison of a scene's material parameters, masses, spacing and frame interval with their ranges in training."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from gpe_pl.schema import MaterialParameter, node_code, param_names
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

RANGE_TOLERANCE = 1e-5
"""Relative difference of material parameters that counts as none, because they are stored in single precision."""
SCALE_TOLERANCE = 1e-6
"""Relative difference of spacings and frame intervals that counts as none."""
FARTHEST = 2.0
"""Factor by which spacing and frame interval of a scene may be outside their ranges in training."""
MASS_FACTOR = 2.0
"""Factor by which masses of nodes may leave the range of training, because corners of meshes differ between bodies of one kind."""
CHOICE = "data=… size=…, or in Python give Trajectory.from_numpy the frame_dt, spacing and materials of the training"
"""What to do about a scene that does not fit a model, if no stride makes it fit."""


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


def any_mass(materials: Sequence[str]) -> Float64[Tensor, "2 material"]:
    """Return the range of masses of each material that excludes none: the value before training."""
    return torch.tensor([[-torch.inf], [torch.inf]], dtype=torch.float64).repeat(1, len(materials))


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


def scale_range(scenes: Iterable[Metadata]) -> Float64[Tensor, "2 scale"]:
    """Return the lowest and highest rest spacing [m] and frame interval [s] of scenes."""
    found = torch.tensor([(scene.spacing, scene.frame_dt) for scene in scenes], dtype=torch.float64)
    return torch.stack([found.amin(dim=0), found.amax(dim=0)])


def have_same_scales(one: Metadata, other: Metadata) -> bool:
    """Tell whether two scenes have the same frame interval, and the same spacing to 1 %."""
    return abs(one.frame_dt / other.frame_dt - 1) < 1e-6 and abs(one.spacing / other.spacing - 1) < 0.01


def are_near(scene: Metadata, trained: Tensor) -> bool:
    """Tell whether spacing and frame interval of a scene are at most ``FARTHEST`` times outside their ranges in training (``scale_range``)."""
    return all(
        low / FARTHEST * (1 - SCALE_TOLERANCE) <= value <= high * FARTHEST * (1 + SCALE_TOLERANCE)
        for value, (low, high) in zip((scene.spacing, scene.frame_dt), trained.T.tolist(), strict=True)
    )


def described_scales(trained: Tensor) -> Iterator[tuple[str, str]]:
    """Yield the names of the two scales, each with its range in training and the unit."""
    for name, unit, (low, high) in zip(("spacing", "frame interval"), ("m", "s"), trained.T.tolist(), strict=True):
        yield name, f"{low:g} to {high:g} {unit}"


def outside_scales(scene: Metadata, trained: Tensor) -> Iterator[tuple[str, str]]:
    """Yield the kind of each scale of a scene that is outside the range of training, and a line that says so."""
    named = zip((scene.spacing, scene.frame_dt), ("m", "s"), described_scales(trained), trained.T.tolist(), strict=True)
    for value, unit, (name, values), (low, high) in named:
        if not low * (1 - SCALE_TOLERANCE) <= value <= high * (1 + SCALE_TOLERANCE):
            yield name, f"{name} is {value:g} {unit}, trained were {values}"


def named_materials(metadata: Metadata) -> str:
    """Return the materials, the parameters that the data set stores besides the first of each, and its loads."""
    further = sorted(set(metadata.param_names) - set(param_names(metadata.materials)))
    given = [
        {"motion": "prescribed nodes", "sliding": "nodes held along some axes", "force": "nodal forces"}[name]
        for name in metadata.loads or ()
    ]
    return ", ".join(metadata.materials) + (f" with {', '.join((*further, *given))}" if (further or given) else "")

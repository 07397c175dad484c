"""Start of a training from a trained simulator, also one of other materials, features, parameters or another domain: what fits is copied, the rest stays new.

Weights and statistics are matched by name. A material that the trained simulator does not know takes those of a known one (``source_materials``). A tensor fits
if it has the same shape. Weights that read material parameters are matched by the names of the parameters. Those of other parameters become zero, so that
predictions do not depend on them at first. Models whose weights have places instead of names (``Model.has_named_weights``) start on the same layout only.

Statistics are copied if both simulators have the same dimension, frame interval and spacing. Otherwise the new ones are kept, because motion in units of its
statistics is alike at all scales. Learned laws of elastic bodies are converted, so that they give the same stresses in Pa.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from gpe_pl.graphs.standardizer import named
from gpe_pl.learned.checkpoint_file import CheckpointError
from gpe_pl.learned.training_ranges import have_same_scales
from gpe_pl.nn.blocks import Standardize
from gpe_pl.schema import MESH_MATERIALS, FeatureSpec, role
from gpe_pl.trajectory.scene_ranges import united
from gpe_pl.trajectory.trajectory import Metadata

if TYPE_CHECKING:
    from gpe_pl.learned.simulator import LearnedSimulator

log = logging.getLogger(__name__)

SHOWN = 5
"""Number of new tensors that are named in messages."""


@dataclass(frozen=True)
class Transfer:
    """What a simulator took from a trained one.

    Attributes:
        sources: for each material, the material of the trained simulator whose weights it has.
        new: parameters of the model that are new, at least in part, by name.
        num_copied, num_weights: number of weights that were copied, and of all weights.
    """

    sources: dict[str, str]
    new: dict[str, nn.Parameter]
    num_copied: int
    num_weights: int

    def __str__(self) -> str:
        renamed = [f"{material} from {source}" for material, source in self.sources.items() if material != source]
        names = [*self.new][:SHOWN] + ([f"{len(self.new) - SHOWN} more"] if len(self.new) > SHOWN else [])
        parts = [f"copied {self.num_copied:,} of {self.num_weights:,} weights", *renamed, f"new: {', '.join(names) or 'none'}"]
        return "; ".join(parts)


def check_model(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    """Raise an error if weights of the trained simulator would mean something else in the new one.

    Raises:
        CheckpointError: the networks have other settings, or weights by place and another layout; or graphs have features relative to another spacing or frame
            interval, or another scale of a material parameter. The message says what to choose.
    """
    if different := _different(new, trained, "model."):
        raise CheckpointError(f"the model to start from is another one; choose {' '.join(different)}")
    if not new.model.has_named_weights:
        _check_layout(new, trained)
    _check_reference(new, trained)
    _check_parameter_scale(new, trained)


@torch.no_grad()
def start_from(new: LearnedSimulator, trained: LearnedSimulator) -> Transfer:
    """Copy to a new simulator, whose statistics are set, what fits of the weights and statistics of a trained one, and log what was copied and what is new.

    Trained ranges then cover both trainings, for materials and parameters that both have.

    Raises:
        CheckpointError: weights of the trained simulator would mean something else (``check_model``).
    """
    check_model(new, trained)
    if different := _different(new, trained, "graph."):
        log.warning("start_from: the trained model has other graphs, with %s; choose these to continue it unchanged", " ".join(different))
    sources = source_materials(new.builder.spec.materials, trained.builder.spec.materials)
    transfer = _copy_weights(new, trained, sources)
    if _same_scales(new, trained):
        _copy_statistics(new, trained, sources)
    else:
        log.warning(
            "start_from: the trained model has another dimension, frame interval or spacing, so statistics are those of the new data"
        )
    _convert_units(new, trained, sources)
    new.set_units_of(new.model)
    _unite_ranges(new, trained)
    log.info("start_from: %s", transfer)
    return transfer


def keep_rollout_settings(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    """Give a simulator that is not trained the settings of rollouts that the trained one has: static friction where its graphs allow it, the mean over mirror
    images, and the least distance in spacings.
    """
    new.static_friction = trained.static_friction if new.builder.spec.islands else 0.0
    new.mirror_average = trained.mirror_average
    new.least_distance = trained.least_distance * new.builder.metadata.spacing / trained.builder.metadata.spacing


def keep_trained_ranges(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    """Give a simulator that is not trained the ranges of the trained one, so that values outside them are still outside.

    New materials and parameters keep theirs.
    """
    before, known = dict(trained.trained_ranges()), [*trained.builder.spec.materials]
    for k, (material, values) in enumerate(new.trained_ranges()):
        if material in known:
            new.trained_mass[:, k] = trained.trained_mass[:, known.index(material)]
            _copy_columns(values, before[material], _parameters(new, material), _parameters(trained, material))
    if _has_same_scale_features(new, trained):
        new.trained_scales.copy_(trained.trained_scales)
    if new.trained_scene.shape == trained.trained_scene.shape:
        new.trained_scene.copy_(trained.trained_scene)


def source_materials(materials: Sequence[str], trained: Sequence[str]) -> dict[str, str]:
    """Return for each material the trained one whose weights it takes: itself, else the first of its kind (with a mesh or without), else the first."""
    chosen = {}
    for material in materials:
        alike = [t for t in trained if (t in MESH_MATERIALS) == (material in MESH_MATERIALS)]
        chosen[material] = material if material in trained else (alike or [*trained])[0]
    return chosen


def _source_name(name: str, sources: dict[str, str]) -> str:
    """Return the name in the trained simulator of a tensor, in whose name materials may stand, alone or in relations."""
    return ".".join("__".join(sources.get(part, part) for part in place.split("__")) for place in name.split("."))


def _different(new: LearnedSimulator, trained: LearnedSimulator, part: str) -> list[str]:
    there, now = _choices(trained), _choices(new)
    return [f"{key}={value}" for key, value in there.items() if key.startswith(part) and now.get(key) != value]


def _choices(simulator: LearnedSimulator) -> dict[str, str]:
    """Return the overrides that choose this model and these graphs. The radius is given in spacings, also if it is the default of the data set."""
    own, scales = simulator.description(), simulator.builder.scales
    spacings = {"connectivity_spacings": float(f"{scales.radius / scales.spacing:.6g}")}
    parts = {"model": {"_target_": own["model"], **own["settings"]}, "graph": own["graph"] | spacings}
    return {
        f"{part}.{key}": value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        for part, values in parts.items()
        for key, value in values.items()
    }


def _check_layout(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    here, there = _layout(new.builder.spec), _layout(trained.builder.spec)
    other = next((part for part in here if here[part] != there[part]), None)
    if other is not None:
        graph = _different(new, trained, "graph.")
        raise CheckpointError(
            f"{type(new.model).__name__} places its weights by the order of materials, parameters and features, and {other} differ: {there[other]} of the "
            f"model to start from, {here[other]} of the new one; choose data with the same dimension, materials, parameters and loads"
            f"{', with ' + ' '.join(graph) if graph else ''}, or train both with model=gpe_tuned, which finds its weights by name"
        )


def _layout(spec: FeatureSpec) -> dict[str, str]:
    """Return what gives weights without names their places, as text for messages."""
    channels = {role(t): f"{count} of {role(t)}" for t, count in spec.node_channels.items()}
    relations = {
        named(r): f"{spec.odd_channels[r]} odd and {spec.even_channels[r]} even of {named(r)}" for r in spec.relations
    }  # levels of virtual nodes have the same weights
    parameters = [f"{p.name} of {material}" for material, own in spec.parameters.items() for p in own]
    parts = {
        "materials": spec.materials,
        "parameters": parameters,
        "channels of nodes": channels.values(),
        "channels of edges": relations.values(),
    }
    return {"dimensions": f"{spec.dim}"} | {part: ", ".join(values) or "none" for part, values in parts.items()}


def _check_reference(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    here, there = _reference(new), _reference(trained)
    if trained.builder.config.scales != "one" and not have_same_scales(here, there):
        raise CheckpointError(
            f"features of the model to start from are relative to spacing={there.spacing:g} m and frame_dt={there.frame_dt:g} s "
            f"(graph.scales={trained.builder.config.scales}), those of the new one to {here.spacing:g} m and {here.frame_dt:g} s; evaluate the model on "
            "other frames as it is with python -m gpe_pl.evaluate … data.stride=…, or choose data with that spacing and frame interval"
        )


def _check_parameter_scale(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    for material, source in source_materials(new.builder.spec.materials, trained.builder.spec.materials).items():
        here = dict(zip(_parameters(new, material), new.standardizer.is_log(material), strict=True))
        there = dict(zip(_parameters(trained, source), trained.standardizer.is_log(source), strict=True))
        for name in here.keys() & there.keys():
            if here[name] != there[name]:
                scale = _choices(trained)["graph.parameter_scale"]
                read = "the logarithm" if there[name] else "the value"
                raise CheckpointError(f"the model to start from reads {read} of {name} of {source}; choose graph.parameter_scale={scale}")


def _reference(simulator: LearnedSimulator) -> Metadata:
    """Return metadata with the spacing and frame interval that are the units of features."""
    return simulator.builder.reference or simulator.builder.metadata


def _has_same_scale_features(new: LearnedSimulator, trained: LearnedSimulator) -> bool:
    """Tell whether both simulators are for several scales and have the same features of them."""
    return new.builder.config.scales == trained.builder.config.scales != "one" and have_same_scales(_reference(new), _reference(trained))


def _same_scales(new: LearnedSimulator, trained: LearnedSimulator) -> bool:
    here, there = new.builder.metadata, trained.builder.metadata
    return here.dim == there.dim and have_same_scales(here, there)


def _parameters(simulator: LearnedSimulator, material: str) -> list[str]:
    return [p.name for p in simulator.builder.spec.parameters[material]]


def _copy_weights(new: LearnedSimulator, trained: LearnedSimulator, sources: dict[str, str]) -> Transfer:
    theirs = trained.model.state_dict()
    reading = new.model.parameter_weights()
    for name, buffer in new.model.named_buffers():
        _copied(buffer, theirs.get(_source_name(name, sources)))
    fresh: dict[str, nn.Parameter] = {}
    num_copied = num_weights = 0
    for name, own in new.model.named_parameters():
        source, num_weights = theirs.get(_source_name(name, sources)), num_weights + own.numel()
        if name in reading:
            material = reading[name]
            here, there = _parameters(new, material), _parameters(trained, sources[material])
            own.zero_()
            copied = own.numel() * _copy_columns(own, source, here, there) // len(here)
        else:
            copied = own.numel() * _copied(own, source)
        num_copied += copied
        if copied < own.numel():
            fresh[name] = own
    return Transfer(sources, fresh, num_copied, num_weights)


def _copy_statistics(new: LearnedSimulator, trained: LearnedSimulator, sources: dict[str, str]) -> None:
    theirs = {name: m for name, m in trained.standardizer.named_modules() if isinstance(m, Standardize) and not m.is_identity}
    for name, own in new.standardizer.named_modules():
        source = theirs.get(_source_name(name, sources))
        if not isinstance(own, Standardize) or source is None:
            continue
        material = name.removeprefix("params.")
        if material != name:
            names = _parameters(new, material), _parameters(trained, sources[material])
            _copy_columns(own.mean, source.mean, *names)
            _copy_columns(own.std, source.std, *names)
        elif own.mean.shape == source.mean.shape:
            own.load_state_dict(source.state_dict())
    new.acceleration_std.copy_(trained.acceleration_std)
    known = [material for material, source in sources.items() if material == source]
    if known:  # their weights are for the trained units; without known materials, masses and stresses may have other units
        new.standardizer.mass.copy_(trained.standardizer.mass)
    with_stress = trained.builder.spec.stress_channels
    if len(known) == len(sources) or any(material in with_stress for material in known):
        new.stress_std.copy_(trained.stress_std)
    new.forget_known_statistics()


def _convert_units(new: LearnedSimulator, trained: LearnedSimulator, sources: dict[str, str]) -> None:
    """Rewrite copied weights that stand for stresses or viscosities, so that these are the same functions of material parameters in SI units."""
    stress, time = _stress_unit(trained) / _stress_unit(new), trained.frame_dt / new.frame_dt
    for material, source in sources.items():
        here, there = (cast(Standardize, s.standardizer.params[m]) for s, m in ((new, material), (trained, source)))
        mean, std = here.mean.clone(), here.std.clone()
        for own, theirs in ((mean, there.mean), (std, there.std)):
            _copy_columns(own, theirs, _parameters(new, material), _parameters(trained, source))
        new.model.convert_units(material, stress, time, shift=(here.mean - mean) / std, scale=here.std / std)


def _stress_unit(simulator: LearnedSimulator) -> float:
    """Return the unit of the constants of elastic bodies [Pa]: mean mass × spacing^(2 − dim) per frame²."""
    return float(simulator.standardizer.mass) * simulator.spacing ** (2 - simulator.builder.spec.dim) / simulator.frame_dt**2


def _copied(own: Tensor, theirs: Tensor | None) -> bool:
    """Copy a tensor into another one of the same shape, and return whether there was one to copy."""
    if theirs is None or theirs.shape != own.shape:
        return False
    own.copy_(theirs)
    return True


def _copy_columns(own: Tensor, theirs: Tensor | None, names: Sequence[str], their_names: Sequence[str]) -> int:
    """Copy the columns of the parameters that both tensors [..., param] have, by name, and return their number."""
    if theirs is None or theirs.shape[:-1] != own.shape[:-1]:
        return 0
    known = [name for name in names if name in their_names]
    for name in known:
        own[..., names.index(name)] = theirs[..., their_names.index(name)]
    return len(known)


def _union(one: Tensor, other: Tensor) -> Tensor:
    """Return the smallest ranges [2, …] of lowest and highest values that contain both."""
    return torch.stack([torch.minimum(one[0], other[0]), torch.maximum(one[1], other[1])])


def _unite_ranges(new: LearnedSimulator, trained: LearnedSimulator) -> None:
    before, known = dict(trained.trained_ranges()), [*trained.builder.spec.materials]
    for k, (material, values) in enumerate(new.trained_ranges()):
        if material not in known:
            continue
        masses, theirs = new.trained_mass[:, k], trained.trained_mass[:, known.index(material)]
        masses.copy_(_union(masses, theirs))
        theirs = values.clone()
        _copy_columns(theirs, before[material], _parameters(new, material), _parameters(trained, material))
        is_known, was_known = (r.isfinite().all(dim=0) for r in (values, theirs))
        values.copy_(torch.where(is_known & was_known, _union(values, theirs), torch.where(was_known, theirs, values)))
    if _has_same_scale_features(new, trained):
        new.trained_scales.copy_(_union(new.trained_scales, trained.trained_scales))
    if new.trained_scene.shape == trained.trained_scene.shape:
        new.trained_scene.copy_(torch.from_numpy(united([trained.trained_scene.cpu().numpy(), new.trained_scene.cpu().numpy()])))

"""Check that every override has an effect, and that it leaves the choices of a config group what they are. Other overrides are refused."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpe_pl.config.folder import CONF

TABLES = (
    *("sizes", "dimensions", "default_dimension", "variant", "base_name", "suffix"),
    *("bounds", "larger", "comparison", "showcase", "split_name"),
)
"""Keys of ``data`` that only hold values for other keys, such as one for each size or dimension."""

NOT_LOOKED_UP = ("base_name", "suffix", "showcase")
"""Keys in ``TABLES`` that are not only for other settings: parts of names, and ``data.showcase``, which ``evaluate`` reads itself."""

SPACING = "data.spacing_factor"
"""Key that is part of a name, and otherwise only for other settings."""

AXES = "axes_of_the_sweep"
"""Key of a copy of the configuration with what an experiment sweeps."""

Condition = tuple[str, Callable[[Any], bool]]

UNREAD: dict[str, Condition | tuple[Condition, ...]] = {
    "training.num_steps": ("training.budget_minutes", lambda minutes: minutes is not None),
    "training.batch_size": ("batching.max_nodes", lambda nodes: nodes is not None),
    "training.warmup_steps": ("training.schedule", lambda schedule: schedule != "cosine"),
    "training.push_steps": ("training.push_fraction", lambda fraction: fraction == 0),
    "training.push_correction": (
        ("training.push_fraction", lambda fraction: fraction == 0),
        ("training.targets", lambda targets: targets == "solver"),
    ),
    "training.noise_correction": ("training.targets", lambda targets: targets == "solver"),
    "training.stress_loss": ("model.stress", lambda stress: stress is False),
    "training.stress_weight": ("model.stress", lambda stress: stress is False),
    "model.stress_unit": ("model.stress", lambda stress: stress is False),
    "model.wall_distance": ("model.elastic", lambda elastic: elastic is False),
    "model.wall_layer": ("model.elastic", lambda elastic: elastic is False),
    "model.wall_damping": ("model.wall_layer", lambda thickness: thickness == 0),
    "model.body_layer": ("model.elastic", lambda elastic: elastic is False),
    "model.only_contacts": ("model.elastic", lambda elastic: elastic is False),
    "model.viscous": ("model.elastic", lambda elastic: elastic is False),
    "graph.num_levels": ("graph.mesh", lambda mesh: not mesh),
    "dimension": ("data.size", lambda size: size == "imported"),
    "data.scales": ("graph.scales", lambda scales: scales is None),  # fit has this key, and simulate and evaluate do not
    "evaluation.num_uncontained": ("evaluation.containment", lambda containment: containment is False),
    "rollout.rest_step_spacings": ("rollout.sleep_after", lambda frames: frames is None),
    "rollout.rest_step_change_spacings": ("rollout.sleep_after", lambda frames: frames is None),
    "active.num_candidates": ("active.models", lambda models: models is None),
    "active.horizon": ("active.models", lambda models: models is None),
}
"""Keys that are unused, with all their entries, for some values of other keys. Each comes with these keys and the tests of their values, which are None for
keys that the command does not have. Keys are also unused where such a key is. The value 0 is always allowed, because it switches the setting off."""


def without_effect(cfg: DictConfig, overrides: Sequence[str], axes: Mapping[str, Any] | None = None) -> str:
    """Describe the first override without an effect, or that changes what a swept choice is; empty if there is none.

    Args:
        cfg: composed configuration, unresolved.
        overrides: overrides ``KEY=VALUE`` from the command line or a sweep.
        axes: values of each key that the experiment sweeps, unresolved.
    """
    typed = dict(_leaves(overrides))
    if message := _switched_off(cfg, typed) or _changes_a_choice(cfg, typed, axes or {}):
        return message
    for key, value in typed.items():
        if _is_looked_up(key) and not _is_read(cfg, key, axes or {}):
            return f"{key}={value}: has no effect, because no other setting takes its value here; leave it out"
        if value != "0" and (reader := _unread_beside(cfg, key)):
            if OmegaConf.select(cfg, reader.partition(".")[0]) is None:
                return f"{key}={value}: has no effect, because this command has no {reader}; leave it out"
            decides = OmegaConf.select(cfg, reader)
            return f"{key}={value}: has no effect with {reader}={'null' if decides is None else decides}; leave out one of the two"
    return ""


def axes_of(hydra_config: Any) -> dict[str, Any]:
    """Return the values of each key that the experiment sweeps, unresolved, from Hydra's own settings."""
    found: Any = OmegaConf.to_container(OmegaConf.select(hydra_config, "sweeper.params") or OmegaConf.create({}))
    return found  # type: ignore[no-any-return]


def _leaves(overrides: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield key and value of each override, and of each entry of those that are tables."""
    for override, parsed in zip(overrides, OverridesParser.create().parse_overrides([*overrides]), strict=True):
        if not parsed.is_delete():
            for key, value in _entries({parsed.key_or_group: parsed.value()}):
                yield key, override.partition("=")[2] if key == parsed.key_or_group else str(value)


def _entries(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield keys and values of a nested table."""
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield from _entries(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def _switched_off(cfg: DictConfig, typed: Mapping[str, str]) -> str:
    """Describe a typed law whose settings the recipe replaces, because recipes are composed later; empty if there is none."""
    if {"law", "recipe"} - set(typed):
        return ""
    for key, value in _set_by("law", typed["law"]).items():
        if key not in typed and (now := OmegaConf.select(cfg, key)) != value:
            return f"law={typed['law']}: recipe={typed['recipe']} sets {key}={now} instead of {value}; leave out one of the two"
    return ""


def _changes_a_choice(cfg: DictConfig, typed: Mapping[str, str], axes: Mapping[str, Any]) -> str:
    """Describe the first override of a setting that makes a swept choice differ from others of its group; empty if there is none.

    Choices of groups with a key of their own, such as ``model``, differ in more than single settings.
    """
    for group, choice in typed.items():
        if group in cfg or group not in axes:
            continue
        own = _set_by(group, choice)
        for key, value in typed.items():
            if not (CONF / key).is_dir() and any(f"{key}.".startswith(f"{each}.") or each.startswith(f"{key}.") for each in own):
                return f"{key}={value}: {group}={choice} sets this key itself, to differ from other choices; leave it out, or leave out this choice"
    return ""


def _set_by(group: str, choice: str) -> dict[str, Any]:
    """Return the settings in the file of a choice, and in the files of its group that it builds on."""
    if not (file := CONF / group / f"{choice}.yaml").is_file():
        return {}
    values: Any = OmegaConf.to_container(OmegaConf.load(file)) or {}
    found: dict[str, Any] = {}
    for base in values.pop("defaults", []):
        found |= _set_by(group, base) if isinstance(base, str) else {}
    return found | dict(_entries(values))


def _conditions(key: str) -> list[Condition]:
    """Return the conditions under which a key is unused."""
    own: Any = UNREAD.get(key) or next((found for table, found in UNREAD.items() if key.startswith(f"{table}.")), ())
    return list(own) if not own or isinstance(own[0], tuple) else [own]


def _unread_beside(cfg: DictConfig, key: str) -> str:
    """Return the key whose value leaves this one unused; empty if it is used."""
    readers = _conditions(key)
    while readers:
        reader, is_unread = readers.pop()
        if is_unread(OmegaConf.select(cfg, reader)):
            return reader
        readers += _conditions(reader)
    return ""


def _is_looked_up(key: str) -> bool:
    """Whether a key belongs to a table of values for other settings, or is another value that only they take."""
    if key == SPACING:
        return True
    first, *rest = key.removeprefix("evaluation.").split(".")
    if first == "size":
        return rest[:1] not in ([], ["name"])
    return first == "data" and rest[:1] != [] and rest[0] in TABLES and not {rest[0], rest[-1]} & {*NOT_LOOKED_UP}


def _is_read(cfg: DictConfig, key: str, axes: Mapping[str, Any]) -> bool:
    """Whether a used setting outside the tables takes this value. If so, it cannot be resolved where the value refers to a key that does not exist."""
    probe = copy.deepcopy(cfg)
    OmegaConf.set_struct(probe, False)
    for unread in UNREAD:
        if OmegaConf.select(cfg, unread.rpartition(".")[0] or unread) is not None and _unread_beside(cfg, unread):
            OmegaConf.update(probe, unread, None)  # what only this setting takes is unused, too
    OmegaConf.update(probe, key, "${no_such_key}")
    OmegaConf.update(probe, AXES, dict(axes))
    try:
        _resolve_settings(probe)
    except OmegaConfBaseException:
        return True
    return False


def _resolve_settings(node: DictConfig, path: str = "") -> None:
    """Resolve all values but those of tables, and names, which are no settings."""
    for name in list(node):
        key = f"{path}{name}"
        if _is_looked_up(key) or name == "name" or OmegaConf.is_missing(node, name):
            continue
        value = node[name]
        if isinstance(value, DictConfig) and not OmegaConf.is_interpolation(node, name):
            _resolve_settings(value, f"{key}.")
        elif isinstance(value, (DictConfig, ListConfig)):
            OmegaConf.to_container(value, resolve=True)

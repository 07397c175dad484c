"""Check that every override has an effect. An override that the run would never read is refused."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpe_pl.files.run_folder import LOOKUPS

OF_SWEEPS = "size.comparison.seeds"
"""Key that is read at the start of a sweep, not in its runs."""

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
}
"""Keys that are unused for some values of other keys, with each of these keys and the test of its value. They are also unused where such a key is. The value 0
is always allowed, because it switches the setting off."""


def without_effect(cfg: DictConfig, overrides: Sequence[str]) -> str:
    """Describe the first override without an effect; empty if there is none.

    Args:
        cfg: composed configuration, unresolved.
        overrides: overrides ``KEY=VALUE`` from the command line or a sweep.
    """
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if _is_in_lookup(key) and not key.startswith(OF_SWEEPS) and not _is_read(cfg, key):
            return f"{key}={value}: has no effect, because no other setting takes its value here; leave it out"
        readers = [] if value == "0" else _conditions(key)
        while readers:
            reader, is_unread = readers.pop()
            if is_unread(decides := OmegaConf.select(cfg, reader)):
                return f"{key}={value}: has no effect with {reader}={'null' if decides is None else decides}; leave out one of the two"
            readers += _conditions(reader)
    return ""


def _conditions(key: str) -> list[Condition]:
    """Return the conditions under which a key is unused."""
    own: Any = UNREAD.get(key, ())
    return list(own) if not own or isinstance(own[0], tuple) else [own]


def _is_in_lookup(key: str) -> bool:
    """Whether a key belongs to a lookup table, or is one of the values of a size that other settings take."""
    parts = key.split(".")
    if len(parts) == 2 and parts[0] == "size":
        return parts[1] not in ("name", *LOOKUPS)
    return len(parts) > 2 and parts[0] in ("data", "size") and parts[1] in LOOKUPS


def _is_read(cfg: DictConfig, key: str) -> bool:
    """Whether another setting uses this entry. In that case, the configuration cannot be resolved without the entry."""
    without = copy.deepcopy(cfg)
    *table, entry = key.split(".")[:3]
    OmegaConf.set_struct(without, False)
    del OmegaConf.select(without, ".".join(table))[entry]
    try:
        OmegaConf.resolve(without)
    except OmegaConfBaseException:
        return True
    return False

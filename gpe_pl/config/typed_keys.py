"""Settings that someone types, or sweeps over, and that would have no effect beside the others: refused instead of left unread."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpe_pl.files.run_folder import OFFERED

OF_SWEEPS = "size.comparison.seeds"
"""Read where a sweep begins, not in its runs."""

UNREAD: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "training.num_steps": ("training.budget_minutes", lambda minutes: minutes is not None),
    "training.batch_size": ("batching.max_nodes", lambda nodes: nodes is not None),
    "training.warmup_steps": ("training.schedule", lambda schedule: schedule == "exponential"),
    "training.push_steps": ("training.push_share", lambda share: share == 0),
    "training.push_correction": ("training.push_share", lambda share: share == 0),
    "training.stress_weight": ("model.stress", lambda stress: stress is False),
    "graph.num_levels": ("graph.mesh", lambda mesh: not mesh),
    "dimension": ("data.size", lambda size: size == "imported"),
}
"""Keys, and for which values of another key nothing reads them. Zero asks for nothing, so it may always be typed."""


def without_effect(cfg: DictConfig, overrides: Sequence[str]) -> str:
    """What to say of the first override that changes nothing; empty if there is none.

    Args:
        cfg: the composed configuration, unresolved.
        overrides: as they are typed, ``KEY=VALUE``, or taken from a sweep.
    """
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if _is_offer(key) and not key.startswith(OF_SWEEPS) and not _is_read(cfg, key):
            return f"{key}={value}: has no effect, because no other setting takes its value here; leave it out"
        other, is_unread = UNREAD.get(key, ("", bool))
        if other and value != "0" and is_unread(decides := OmegaConf.select(cfg, other)):
            return f"{key}={value}: has no effect with {other}={'null' if decides is None else decides}; leave out one of the two"
    return ""


def _is_offer(key: str) -> bool:
    """Whether a key is part of a table that others may refer to."""
    parts = key.split(".")
    return len(parts) > 2 and parts[0] in ("data", "size") and parts[1] in OFFERED


def _is_read(cfg: DictConfig, key: str) -> bool:
    """Whether anything refers to the entry of a table that a key is part of: without it, the configuration cannot be resolved."""
    without = copy.deepcopy(cfg)
    group, table, entry = key.split(".")[:3]
    OmegaConf.set_struct(without, False)
    del without[group][table][entry]
    try:
        OmegaConf.resolve(without)
    except OmegaConfBaseException:
        return True
    return False

"""Hydra reads each file of ``conf`` once, and composes each configuration once, per process of the tests.

Tests compose hundreds of configurations, many of them several times. Each composition reads dozens of files.
"""

from __future__ import annotations

import pickle
from collections.abc import Hashable, Sequence
from typing import Any

import hydra
from hydra._internal.config_repository import ConfigRepository
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.config_source import ConfigResult

from gpe_pl.config.folder import CONF

_load, _compose = ConfigRepository.load_config, hydra.compose
_known: dict[Hashable, bytes] = {}


def load_once(self: ConfigRepository, config_path: str) -> ConfigResult | None:
    """Return a copy of what the first call returned, unless Hydra searches other folders, too."""
    if [source.path for source in self.get_sources() if source.scheme() == "file"] != [str(CONF)]:
        return _load(self, config_path)
    if config_path not in _known:
        _known[config_path] = pickle.dumps(_load(self, config_path))
    result: ConfigResult | None = pickle.loads(_known[config_path])
    return result


def compose_once(config_name: str | None = None, overrides: Sequence[str] = (), return_hydra_config: bool = False) -> Any:
    """Return a copy of what the first call with these arguments returned, unless Hydra searches other folders, too."""
    searched = GlobalHydra.instance().config_loader().get_search_path().get_path()
    if [item.path for item in searched if "://" not in str(item.path)] != [str(CONF)]:
        return _compose(config_name, [*overrides], return_hydra_config)
    key = (config_name, *overrides, return_hydra_config)
    if key not in _known:
        _known[key] = pickle.dumps(_compose(config_name, [*overrides], return_hydra_config))
    return pickle.loads(_known[key])


ConfigRepository.load_config = load_once  # type: ignore[method-assign]
hydra.compose = compose_once  # type: ignore[assignment]

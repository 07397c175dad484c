"""Hydra reads each file of ``conf`` once, and composes each configuration once, per process of the tests.

Tests compose hundreds of configurations, many of them several times. For each one Hydra reads dozens of files. For each file it writes a table of all
choices, which only a list of defaults with interpolations needs, and it parses each interpolation again. Here it does this once, or not at all.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from typing import Any, TypeVar

import hydra
import omegaconf.base
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository, IConfigRepository
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig

from gpe_pl.config.folder import CONF

T = TypeVar("T")
_load, _embed, _compose = ConfigRepository.load_config, ConfigLoaderImpl._load_single_config, hydra.compose
_choices = defaults_list._create_interpolation_map
_known: dict[Hashable, bytes] = {}


def copy_of_first(key: Hashable, make: Callable[[], T]) -> T:
    """Return a copy of what was made at the first call with this key."""
    if key not in _known:
        _known[key] = pickle.dumps(make())
    result: T = pickle.loads(_known[key])
    return result


def reads_only_conf(repository: IConfigRepository) -> bool:
    return [source.path for source in repository.get_sources() if source.scheme() == "file"] == [str(CONF)]


def load_once(self: ConfigRepository, config_path: str) -> ConfigResult | None:
    """Return a copy of what the first call returned, unless Hydra searches other folders, too."""
    return copy_of_first(config_path, lambda: _load(self, config_path)) if reads_only_conf(self) else _load(self, config_path)


def embed_once(self: ConfigLoaderImpl, default: ResultDefault, repo: IConfigRepository) -> ConfigResult:
    """Return a copy of the first result with the same file and place, unless Hydra searches other folders, too."""
    if not reads_only_conf(repo):
        return _embed(self, default, repo)
    return copy_of_first((default.config_path, default.package, default.primary), lambda: _embed(self, default, repo))


def compose_once(config_name: str | None = None, overrides: Sequence[str] = (), return_hydra_config: bool = False) -> Any:
    """Return a copy of what the first call with these arguments returned, unless Hydra searches other folders, too."""
    searched = GlobalHydra.instance().config_loader().get_search_path().get_path()
    if [item.path for item in searched if "://" not in str(item.path)] != [str(CONF)]:
        return _compose(config_name, [*overrides], return_hydra_config)
    return copy_of_first(
        ("composed", config_name, *overrides, return_hydra_config), lambda: _compose(config_name, [*overrides], return_hydra_config)
    )


def choices_where_needed(overrides: Any, defaults: list[InputDefault], self_added: bool) -> DictConfig:
    """Return the table from which interpolations in a list of defaults are resolved; it is empty if there are none."""
    return _choices(overrides, defaults, self_added) if any(d.is_interpolation() for d in defaults if not d.is_self()) else DictConfig({})


defaults_list._create_interpolation_map = choices_where_needed  # type: ignore[assignment]
omegaconf.base.parse = cache(omegaconf.base.parse)  # type: ignore[attr-defined]
ConfigRepository.load_config = load_once  # type: ignore[method-assign]
ConfigLoaderImpl._load_single_config = embed_once  # type: ignore[method-assign]
hydra.compose = compose_once  # type: ignore[assignment]

"""Registration of the project's launchers and sweeper with Hydra."""

from __future__ import annotations

import importlib
import sys
from dataclasses import fields
from types import ModuleType
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins

from gpe_pl.config import launcher, sweeper

NAMESPACE = "hydra_plugins"
"""Namespace package from which Hydra takes plugins. It exists only if another plugin is installed."""

LAUNCHERS: dict[str, tuple[Any, Any]] = {
    "processes": (launcher.ProcessLauncher, launcher.ProcessLauncherConfig),
    "ray": (launcher.RayLauncher, launcher.RayLauncherConfig),
    "slurm": (launcher.SlurmLauncher, launcher.SlurmLauncherConfig),
}
SWEEPERS: dict[str, tuple[Any, Any]] = {"optuna": (sweeper.OptunaSweeper, sweeper.OptunaSweeperConfig)}


def register() -> None:
    """Register the choices of ``hydra/launcher=…`` and ``hydra/sweeper=…``."""
    try:
        package = importlib.import_module(NAMESPACE)
    except ImportError:
        package = sys.modules[NAMESPACE] = ModuleType(NAMESPACE)
        package.__path__ = []
    own = ModuleType(f"{NAMESPACE}.gpe_pl")
    package.__dict__["gpe_pl"] = sys.modules[own.__name__] = own
    for group, plugins in (("launcher", LAUNCHERS), ("sweeper", SWEEPERS)):
        for name, (plugin, config) in plugins.items():
            setattr(own, plugin.__name__, plugin)
            plugin.__module__ = own.__name__
            node = {"_target_": f"{own.__name__}.{plugin.__name__}", **{f.name: getattr(config(), f.name) for f in fields(config)}}
            ConfigStore.instance().store(group=f"hydra/{group}", name=name, node=node, provider="gpe_pl")
            Plugins.instance().register(plugin)

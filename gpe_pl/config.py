"""Configuration: Hydra entry points with readable errors, and construction of checked objects from config nodes.

Hydra composes; nothing else in the package knows it. A misspelt key, group or choice is refused at composition with the valid ones; a value of the wrong
type or out of range is refused by the signature of the class or function that takes it.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import ConfigDict, ValidationError, create_model

from gpe_pl.errors import GpeError

CONF = Path(__file__).resolve().parent.parent / "conf"
T = TypeVar("T")


class ConfigError(GpeError, ValueError):
    """A config value is not allowed; the message names key, value and what is allowed."""


def construct(target: Callable[..., T], settings: Mapping[str, Any], path: str, **given: Any) -> T:
    """Call ``target(**settings, **given)`` after checking ``settings`` against the types and ranges of its signature.

    Args:
        target: class or function whose parameters are annotated; ranges as ``Annotated[int, pydantic.Field(ge=1)]``.
        settings: a config node.
        path: of the node in the config, for messages.
        given: arguments that do not come from the config, passed unchecked.

    Raises:
        ConfigError: unknown or missing key, wrong type or value out of range.
    """
    annotated = target.__init__ if inspect.isclass(target) and not is_dataclass(target) else target
    hints = get_type_hints(annotated, include_extras=True)
    fields: dict[str, Any] = {}
    for name, parameter in inspect.signature(target).parameters.items():
        if name not in given:
            default = ... if parameter.default is inspect.Parameter.empty else parameter.default
            fields[name] = (hints.get(name, Any), default)
    values = OmegaConf.to_container(settings, resolve=True) if isinstance(settings, DictConfig) else dict(settings)
    unknown = set(values) - set(fields)
    if unknown:
        raise ConfigError(f"{path}.{min(unknown)}: unknown key; valid keys: {', '.join(fields)}")
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, protected_namespaces=())
    checker = create_model("Settings", __config__=config, **fields)
    try:
        checked = checker(**values)
    except ValidationError as error:
        raise ConfigError(_one_line(error, path)) from None
    try:
        return target(**{name: getattr(checked, name) for name in fields}, **given)
    except ValueError as error:
        if isinstance(error, GpeError):
            raise
        raise ConfigError(f"{path}: {error}") from error


def _one_line(error: ValidationError, path: str) -> str:
    parts = []
    for e in error.errors():
        key = ".".join([path, *(str(k) for k in e["loc"] if isinstance(k, (str, int)))])
        value = "" if e["type"] == "missing" else f"={e['input']!r}"
        message = e["msg"][0].lower() + e["msg"][1:]
        parts.append(f"{key}{value}: {message}")
    return "; ".join(dict.fromkeys(parts))


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], Any]]:
    """``hydra.main`` for one of the files in ``conf/``, with one-line errors: ``GpeError`` and configuration errors exit with 2 and no traceback.

    Set HYDRA_FULL_ERROR=1 to see tracebacks.
    """

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], Any]:
        verbose = os.environ.get("HYDRA_FULL_ERROR") == "1"

        def run(cfg: DictConfig) -> Any:
            try:
                OmegaConf.resolve(cfg)
                return task(cfg)
            except (GpeError, OmegaConfBaseException) as error:
                if verbose:
                    raise
                _fail(error)

        def main() -> Any:
            if not CONF.is_dir():
                _fail(ConfigError(f"{CONF} not found: install gpe_pl from a clone with `pip install -e .`"))
            os.environ["HYDRA_FULL_ERROR"] = "1"  # let exceptions reach us instead of Hydra's own report
            try:
                return hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)(run)()
            except (HydraException, OmegaConfBaseException) as error:
                if verbose:
                    raise
                _fail(ConfigError(explain(error, config_name, sys.argv[1:])))

        return main

    return decorate


def _fail(error: Exception) -> None:
    print("error: " + " ".join(str(error).split()), file=sys.stderr)
    sys.exit(2)


def explain(error: Exception, config_name: str, overrides: list[str]) -> str:
    """One line for a composition error, with the valid keys or choices."""
    text = " ".join(str(error).split())
    match = re.search(r"Could not override '([^']+)'", text)
    if match is None:
        return re.sub(r" ?Config search path:.*| ?Set the environment variable.*", "", text)
    key = match.group(1).partition("@")[0].lstrip("+~")
    parent, _, leaf = key.rpartition(".")
    if "Could not find" in text or "In '" in text:
        return text
    others = [o for o in overrides if "=" in o and not o.startswith(("-", "hydra")) and o.partition("=")[0].lstrip("+~") != key]
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            node: Any = hydra.compose(config_name, others)
            while parent and not isinstance(OmegaConf.select(node, parent), DictConfig):
                parent = parent.rpartition(".")[0]  # the misspelling is higher up
                leaf = key.removeprefix(f"{parent}.").partition(".")[0]
            node = OmegaConf.select(node, parent) if parent else node
            keys = ", ".join(sorted(str(k) for k in node))
    except (HydraException, OmegaConfBaseException):
        return text
    return f"{key}: unknown key {leaf!r}; valid keys{f' of {parent}' if parent else ''}: {keys}"


def output_dir() -> Path:
    """Folder of the running job."""
    return Path(HydraConfig.get().runtime.output_dir)


class SweepReport(Callback):
    """Aggregates the runs of a sweep when it ends: tables and figures in the sweep's folder."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        from gpe_pl.report import report_sweep

        report_sweep(Path(config.hydra.sweep.dir))

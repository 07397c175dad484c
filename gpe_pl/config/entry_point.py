"""Configuration: Hydra entry points with readable errors, and construction of checked objects from config nodes.

Hydra composes configurations; only this room and the commands import it. Composition refuses a misspelt key, group or choice and lists the valid ones. The
signature of a class or function refuses values of the wrong type or out of range.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException
from pydantic import ValidationError

from gpe_pl.config import plugins
from gpe_pl.config.explanations import ConfigError, check_arguments, explain, groups, refusal, violations
from gpe_pl.config.folder import CONF
from gpe_pl.config.launcher import RESULT, USAGE_ERROR, SweepError, end_with_sweep
from gpe_pl.config.typed_keys import axes_of, without_effect
from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import clean_messages, did_you_mean, one_line, speak_utf8
from gpe_pl.files.atomic import replace_text, unnamed
from gpe_pl.files.names import NameRefused, run_name, spacing_suffix, sweep_name
from gpe_pl.files.run_folder import refuse_links
from gpe_pl.learned.pretrained import model_name
from gpe_pl.system import early_interrupts
from gpe_pl.system.signatures import checked, parameters
from gpe_pl.viz.saving import further_formats

WITHOUT_KEY = {"adaptation", "comparison", "experiment", "law", "parameters", "recipe", "scaling", "scene", "solver", "tuned"}
"""Config groups that set keys under other names than their own. A command may have a key of its own by such a name, as convert has ``parameters``."""

plugins.register()  # files in conf/ use the plugins
OmegaConf.register_new_resolver("times", lambda a, b: a * b, replace=True)  # ${times:a,b} in conf/
OmegaConf.register_new_resolver("plus", lambda a, b: a + b, replace=True)
OmegaConf.register_new_resolver("model_name", model_name, replace=True)  # ${model_name:checkpoint,runs}

OmegaConf.register_new_resolver("run_name", run_name, replace=True)  # ${run_name:name} in conf/ checks the name of a results folder
OmegaConf.register_new_resolver("sweep_name", sweep_name, replace=True)
OmegaConf.register_new_resolver("fine_suffix", lambda fine: "" if fine == 1 else f"_fine{fine}", replace=True)  # of names of data sets
OmegaConf.register_new_resolver("spacing_suffix", spacing_suffix, replace=True)
OmegaConf.register_new_resolver("stress_suffix", lambda stress: "_stress" if stress is True else "", replace=True)

T = TypeVar("T")


def _refused(message: str) -> None:
    """Resolver ``${refused:"…"}`` for a value that other files in ``conf/`` have to replace."""
    raise ConfigError(message)


OmegaConf.register_new_resolver("refused", _refused, replace=True)
_results: list[Path] = []
"""Results folders of this process, which ``Report`` adds."""

LARGEST_INTEGER = 2**63 - 1
"""Largest integer setting, a limit of NumPy and PyTorch."""
PLAIN = re.compile(r"[A-Za-z0-9_/\\:\-+.$%*@?| ]*")
"""Values that Hydra's grammar takes without quotes."""


@dataclass(frozen=True)
class Paths:
    """Folders, relative to the current folder.

    Attributes:
        data: folder of generated and imported data sets.
        runs: folder of results.
    """

    data: str
    runs: str


def construct(target: Callable[..., T], settings: Mapping[str, Any], path: str, **given: Any) -> T:
    """Call ``target(**settings, **given)`` after checking ``settings`` against the types and ranges in the signature of ``target``.

    Args:
        target: class or function with annotated parameters; ranges are annotated as ``Annotated[int, pydantic.Field(ge=1)]``.
        settings: config node.
        path: path of the node in the config, for messages.
        given: arguments that do not come from the config; they are passed unchecked.

    Raises:
        ConfigError: a key is unknown or missing, a type is wrong, a value is out of range, or ``target`` refuses the values.
    """
    return bind(target, settings, path, *given)(**given)


def construct_target(settings: Any, path: str, package: str) -> Any:
    """Construct the class that ``_target_`` names from the other settings. It must lie in ``package``.

    Raises:
        ConfigError: the package has no such class, or the settings do not fit it.
    """
    if not isinstance(settings, Mapping):
        raise ConfigError(f"{path}={settings!r}: must be a table with a _target_, a class of {package.rstrip('.')}")
    values = dict(settings)
    target = str(values.pop("_target_", None))
    module, _, name = target.rpartition(".")
    try:
        if not f"{module}.".startswith(package):
            raise ImportError
        cls = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        raise ConfigError(f"{path}._target_={target!r}: must be a class of {package.rstrip('.')}") from None
    return construct(cls, values, path)


def bind(target: Callable[..., T], settings: Mapping[str, Any], path: str, *later: str) -> Callable[..., T]:
    """Check settings as ``construct`` does, and return a function that calls the target once the arguments ``later`` are known."""
    values: Any = OmegaConf.to_container(settings, resolve=True) if isinstance(settings, DictConfig) else dict(settings)
    valid = parameters(target, *later)
    unknown = set(values) - set(valid)
    if unknown:
        raise ConfigError(f"{path}.{min(unknown)}: unknown key{did_you_mean(min(unknown), valid)}; valid keys: {', '.join(valid)}")
    for key, number in _integers(values, path):
        if abs(number) > LARGEST_INTEGER:
            raise ConfigError(f"{key}={number}: must be within ±{LARGEST_INTEGER}")
    try:
        arguments = checked(target, values, *later)
    except ValidationError as error:
        raise ConfigError(violations(error, path)) from None

    def call(**given: Any) -> T:
        try:
            return target(**arguments, **given)
        except ValidationError as error:  # from a class that checks combinations of its values
            raise ConfigError(violations(error, path)) from None
        except ValueError as error:
            if isinstance(error, GpeError):
                raise
            raise ConfigError(f"{path}: {error}") from error

    return call


def _integers(value: Any, path: str) -> Iterator[tuple[str, int]]:
    """Yield all integers in nested settings with their paths."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _integers(item, f"{path}.{key}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _integers(item, f"{path}.{k}")
    elif isinstance(value, int):
        yield path, value


def entry_point(config_name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], Any]]:
    """Create the main function of a command from a file in ``conf/``; a decorator like ``hydra.main``, with one-line errors.

    ``GpeError``, ``OSError`` and configuration errors end the process with status 2 and without a traceback. In a job of a sweep, configuration errors have the
    status ``launcher.USAGE_ERROR``. Set HYDRA_FULL_ERROR=1 to see tracebacks.
    """

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], Any]:
        verbose, is_composed = os.environ.get("HYDRA_FULL_ERROR") == "1", False

        def run(cfg: DictConfig) -> Any:
            nonlocal is_composed
            is_composed = True
            if RESULT in os.environ:
                end_with_sweep()
            try:
                if "dimension" in list(cfg) and cfg.dimension not in (2, 3):
                    raise ConfigError(f"dimension={cfg.dimension}: must be 2 or 3")
                typed = HydraConfig.get().overrides.task
                if unread := without_effect(cfg, typed, axes_of(HydraConfig.get())):
                    raise ConfigError(unread)
                OmegaConf.resolve(cfg)
                _check_device(cfg, config_name, typed)
                construct(Paths, cfg.paths, "paths")
                _check_top_level(cfg, config_name)
                _check_name(cfg, config_name)
                value = task(cfg)
                if RESULT in os.environ:
                    replace_text(Path(os.environ[RESULT]), json.dumps(value))
                return value
            except InterpolationKeyError as error:
                if verbose:
                    raise
                hint = "; data, scene, dimension and parameters do not fit together" if "'data." in str(error) else ""
                _fail(ConfigError(f"{' '.join(str(error).split())}{hint}"))
            except (
                GpeError,
                OmegaConfBaseException,
                OSError,
            ) as error:  # OSError: full disks, folders that cannot be written, missing files
                if verbose:
                    raise
                if (known := refusal(error)) is not None:
                    _fail(ConfigError(known))
                _fail(unnamed(error, _written(cfg.paths)) if isinstance(error, OSError) else error)

        def main() -> Any:
            if not CONF.is_dir():
                _fail(ConfigError(f"{CONF} not found: install gpe_pl again"))
            early_interrupts.end()
            speak_utf8()
            clean_messages()
            try:
                check_arguments(sys.argv[1:], config_name)
                further_formats()
            except GpeError as error:
                _fail(error)
            sys.argv[1:] = [quoted(argument) for argument in sys.argv[1:]]
            os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions reach this function, without Hydra's report
            try:
                return hydra.main(version_base="1.3", config_path=str(CONF), config_name=config_name)(run)()
            except KeyboardInterrupt:
                print(early_interrupts.NOTICE, file=sys.stderr)
                sys.exit(early_interrupts.STATUS)
            except SweepError as error:
                _fail(error)
            except (HydraException, OmegaConfBaseException, ValueError) as error:  # before OSError: some errors of Hydra are one too
                if verbose or (is_composed and isinstance(error, ValueError)):
                    raise
                _fail(ConfigError(explain(error, config_name, sys.argv[1:])))
            except OSError as error:  # Hydra creates the results folder before the command begins
                if verbose:
                    raise
                if error.filename is None:
                    _fail(unnamed(error, _written()))
                _fail(
                    OSError(
                        f"{error.filename}: cannot be made or written ({error.strerror}); choose another folder with paths.runs=… or paths.data=…"
                    )
                )

        return main

    return decorate


def quoted(argument: str) -> str:
    """Quote the value of an override if it is a path with characters for which Hydra requires quotes: ``=``, as in folders of sweeps, or ``ü``.

    A path exists, or its folder does and it has no comma, which would separate values of a sweep.
    """
    key, _, value = argument.partition("=")
    if PLAIN.fullmatch(value) or value[0] in "\"'[{":
        return argument
    # Path.exists fails on names that are too long
    is_path = os.path.exists(value) or ("," not in value and os.path.isdir(os.path.dirname(value)))
    if not is_path:
        return argument
    # Hydra reads backslashes before a quote as escapes
    escaped = re.sub(r'(\\*)("|$)', lambda m: 2 * m[1] + ('\\"' if m[2] else ""), value)
    return f'{key}="{escaped}"'


def compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """Return the resolved config of ``python -m gpe_pl.{config_name} {overrides}`` without running the command.

    Raises:
        ConfigError: an override is not valid; the message names the valid keys.
    """
    try:
        if GlobalHydra.instance().is_initialized():
            cfg = hydra.compose(config_name, [*overrides])
        else:
            with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
                cfg = hydra.compose(config_name, [*overrides])
        OmegaConf.resolve(cfg)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error, config_name, [*overrides])) from None
    _check_top_level(cfg, config_name)
    return cfg


def _written(paths: Mapping[str, str] | None = None) -> list[Path]:
    """Return the folders that this process and its libraries write to."""
    own = [*_results] if paths is None else [*paths.values()]
    temporary: list[str] = []
    with contextlib.suppress(FileNotFoundError):  # no temporary folder can be written
        temporary.append(tempfile.gettempdir())
    return [Path(folder) for folder in (*own, os.environ.get("NUMBA_CACHE_DIR", "."), *temporary, Path.cwd())]


def _fail(error: Exception) -> None:
    with contextlib.suppress(OSError):  # the standard error may be a file on a full disk
        print(f"error: {one_line(str(error))}", file=sys.stderr)
    sys.exit(USAGE_ERROR if RESULT in os.environ and isinstance(error, (ConfigError, NameRefused)) else 2)


def _check_device(cfg: DictConfig, config_name: str, typed: Sequence[str]) -> None:
    """Raise ``ConfigError`` before any work is done if there is no GPU for ``trainer=gpu``, or if a command in one process gets several.

    The message names what was typed.
    """
    if config_name != "fit" and (count := num_processes(cfg)) > 1:
        key = next((override for override in typed if override.lstrip("+").startswith("trainer")), "trainer")
        raise ConfigError(f"{key}: sets {count} processes, and only gpe_pl.fit computes in several; leave it out")
    if OmegaConf.select(cfg, "trainer.accelerator") != "gpu":
        return
    import torch

    if not torch.cuda.is_available():
        key = next((override for override in typed if override.lstrip("+").startswith("trainer")), "trainer.accelerator=gpu")
        raise ConfigError(f"{key}: PyTorch finds no GPU here; choose trainer=cpu, or install a PyTorch that supports your GPU")


def _check_top_level(cfg: DictConfig, config_name: str) -> None:
    file = OmegaConf.load(CONF / f"{config_name}.yaml")
    known = {*groups(config_name), *map(str, file)} - {"defaults", "hydra"}
    wrong = {str(k) for k in cfg} ^ (known - (WITHOUT_KEY - set(file)))
    if wrong:
        raise ConfigError(f"{min(wrong)}: unknown or missing key{did_you_mean(min(wrong), known)}; valid keys: {', '.join(sorted(known))}")


def _check_name(cfg: DictConfig, config_name: str) -> None:
    file = OmegaConf.load(CONF / f"{config_name}.yaml")
    if "name" in cfg and OmegaConf.to_container(file)["name"] is not None:  # type: ignore[call-overload,index]
        try:
            run_name(cfg.name)
        except NameRefused as error:
            raise ConfigError(str(error)) from None


def output_dir(cfg: DictConfig) -> Path:
    """Return the results folder of the running job. Outside a Hydra job, as in a notebook, this is the folder of a single run."""
    return Path(HydraConfig.get().runtime.output_dir) if HydraConfig.initialized() else Path(cfg.paths.runs) / run_name(cfg.name)


def num_processes(cfg: DictConfig) -> int:
    """Return ``trainer.devices`` × ``trainer.num_nodes``, the number of processes of a training. A setting that is not an integer counts as 1."""
    counts = [OmegaConf.select(cfg, f"trainer.{key}") for key in ("devices", "num_nodes")]
    return math.prod(count if type(count) is int else 1 for count in counts)


class Report(Callback):
    """Hydra callback that locks the results folder of a run or sweep before anything is written, and writes tables and figures at the end."""

    def __init__(self) -> None:
        self._lock = contextlib.ExitStack()

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        with contextlib.suppress(OmegaConfBaseException):  # a refused name, which Hydra resolves again and reports
            self._lock_folder(Path(config.hydra.run.dir), config, num_processes(config))

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        with contextlib.suppress(OmegaConfBaseException):
            self._lock_folder(Path(config.hydra.sweep.dir), config)

    def _lock_folder(self, folder: Path, config: DictConfig, num_processes: int = 1) -> None:
        """Lock the folder until the process ends, and end the process if the folder cannot be used.

        Hydra would turn an exception of a callback into a warning and continue.
        """
        from gpe_pl.system.locks import is_later_process, locked
        from gpe_pl.system.provenance import recorded

        _results.append(folder)
        try:
            refuse_links(folder)
            self._lock.enter_context(locked(folder, num_processes=num_processes))
            if num_processes == 1 or not is_later_process():
                self._lock.enter_context(recorded(folder, config.hydra.job.name, sys.argv[1:], str(config.paths.runs)))
        except GpeError as error:
            _fail(error)
        except OSError as error:
            _fail(ConfigError(f"{folder}: cannot be read or written ({error.strerror}); choose another folder with paths.runs=…"))
        atexit.register(self._release)

    def _release(self) -> None:
        with contextlib.suppress(GpeError):  # the folder was deleted, which has already ended the command
            self._lock.close()

    def on_run_end(self, config: DictConfig, **_: Any) -> None:
        self._report(Path(config.hydra.run.dir), is_sweep=False)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        self._report(Path(config.hydra.sweep.dir), is_sweep=True)

    def _report(self, folder: Path, is_sweep: bool) -> None:
        """Write tables and figures, and end the process on failure.

        Hydra would turn an exception of a callback into a warning, and the command would seem to have succeeded.
        """
        try:
            if is_sweep:
                from gpe_pl.benchmarks.forward_times import measure_forward_times
                from gpe_pl.reports.finished_runs import finished_runs
                from gpe_pl.reports.tables import write_tables

                runs = finished_runs(folder)
                measure_forward_times(folder, runs)
                table = write_tables(folder, runs)
                if table.exists():  # at least one run has finished
                    print(table.read_text(encoding="utf-8"))
            else:
                from gpe_pl.reports.sweep_table import conclusion, report

                report(folder)
                if (folder / "metrics.csv").exists():
                    print(conclusion(folder))
            print(folder)
            self._lock.close()  # raises if the folder was deleted meanwhile
        except GpeError as error:
            _fail(error)
        except Exception as error:
            sys.excepthook(type(error), error, error.__traceback__)
            sys.exit(1)

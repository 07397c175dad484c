"""Loggers of a run: CSV files in its folder always, and Weights & Biases (W&B) or TensorBoard if configured."""

from __future__ import annotations

import logging
import netrc
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlparse

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.files.run_folder import RUN_ID, TENSORBOARD

log = logging.getLogger(__name__)

WANDB_URL = "https://api.wandb.ai"
FILMS: tuple[Literal["gif", "mp4"], ...] = ("gif", "mp4")
MODES = ("online", "offline", "disabled", "dryrun", "run", "shared")
"""Modes that W&B takes from ``WANDB_MODE``."""


@dataclass(frozen=True)
class LoggerSettings:
    """Where to log metrics. CSV files in the run's folder are always written.

    Attributes:
        kind: ``wandb`` also logs to W&B, ``tensorboard`` to event files in the run's folder.
        project: project in W&B.
        mode: mode of W&B. None takes ``WANDB_MODE``, or else ``online`` if there is an API key and ``offline`` if not.
    """

    kind: Literal["csv", "wandb", "tensorboard"] = "csv"
    project: str = "gpe_pl"
    mode: Literal["online", "offline", "disabled"] | None = None

    def __post_init__(self) -> None:
        if self.kind == "wandb" and self.mode is None:
            mode_of_environment()  # refuses a wrong one before data are generated

    def loggers(self, run_dir: Path, name: str, config: Mapping[str, Any]) -> list[Logger]:
        """Return loggers of a run: CSV under ``run_dir/log``, one version per start of the run, and W&B or TensorBoard if configured.

        Args:
            run_dir: folder of the run; it keeps the identifier under which a resumed run continues in W&B.
            name: name of the experiment or sweep that the run belongs to; the group in W&B.
            config: configuration of the run, shown in W&B.

        Raises:
            TrackingError: W&B refuses the run, or TensorBoard is not installed.
        """
        loggers: list[Logger] = [Log(run_dir, name="log", flush_logs_every_n_steps=1)]
        if self.kind == "wandb":
            mode = self.mode or mode_of_environment() or ("online" if has_key() else "offline")
            loggers.append(self._wandb(run_dir, name, config, mode))
        if self.kind == "tensorboard":
            try:
                import tensorboard  # noqa: F401
            except ImportError:
                raise TrackingError(
                    "logger=tensorboard: needs tensorboard: `pip install 'gpe_pl[tensorboard]'`, or choose logger=csv"
                ) from None
            loggers.append(TensorBoardLogger(run_dir, name="", version=TENSORBOARD))
        return loggers

    def _wandb(self, run_dir: Path, name: str, config: Mapping[str, Any], mode: str) -> Logger:
        import wandb
        from lightning.pytorch.loggers import WandbLogger

        _, is_within, rest = f"/{run_dir.as_posix()}/".rpartition(f"/{name}/")
        own = rest.rstrip("/") if is_within else ""  # within a sweep, this run's own part
        options: dict[str, Any] = {"group": name, "mode": mode, "resume": "allow"}
        own_id = run_id(run_dir) if rank_zero_only.rank == 0 else None  # type: ignore[attr-defined]  # only the first process logs
        logger = WandbLogger(own or name, save_dir=run_dir, project=self.project, id=own_id, **options)
        try:
            logger.log_hyperparams({**config, "run_dir": str(run_dir)})
        except wandb.errors.Error as error:
            if isinstance(error, wandb.errors.CommError) and mode != "offline":  # no network, or a key that is not accepted
                log.warning("W&B: %s; this run is kept offline", error)
                wandb.teardown()  # ends what it began under this identifier
                return self._wandb(run_dir, name, config, "offline")
            raise TrackingError(f"W&B: {error}; logger.mode=offline keeps the run here") from None
        return logger


class Log(CSVLogger):
    """CSV logger that replaces its file as a whole, so that a reader never sees a number that is cut off."""

    @rank_zero_only
    def save(self) -> None:
        """Write the metrics logged since the last call.

        Raises:
            FullDiskError: the disk is full.
        """
        writer: Any = self.experiment
        path = Path(writer.metrics_file_path)
        if not writer.metrics:
            return
        with replacing(path) as part:
            if path.exists():
                shutil.copyfile(path, part)
            writer.metrics_file_path = str(part)
            try:
                super().save()
            finally:
                writer.metrics_file_path = str(path)


class TrackingError(GpeError):
    """Raised when metrics cannot be logged as configured; the message says why."""


def has_key() -> bool:
    """Whether this user has an API key for W&B, in ``WANDB_API_KEY`` or in ``~/.netrc``, where ``wandb login`` stores it."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = urlparse(os.environ.get("WANDB_BASE_URL", WANDB_URL)).hostname or ""
    try:
        found = netrc.netrc(os.environ.get("NETRC")).authenticators(host)
    except (OSError, netrc.NetrcParseError):
        return False
    return found is not None and bool(found[2])


def mode_of_environment() -> str | None:
    """Return the mode of W&B in ``WANDB_MODE``, or None if there is none.

    Raises:
        TrackingError: W&B has no such mode.
    """
    mode = os.environ.get("WANDB_MODE")
    if mode and mode not in MODES:
        raise TrackingError(f"WANDB_MODE={mode}: W&B has no such mode; it must be one of {', '.join(MODES)}")
    return mode or None


def run_id(run_dir: Path) -> str:
    """Return the identifier of a run in W&B. It is written to ``RUN_ID`` once, so that a resumed run finds it again.

    Raises:
        TrackingError: the file holds something else, which W&B would use in paths.
    """
    path = run_dir / RUN_ID
    if not path.exists():
        replace_text(path, os.urandom(6).hex())
    text = path.read_bytes()[:100].decode(errors="replace").strip()
    if not re.fullmatch("[0-9a-z]{1,32}", text):
        raise TrackingError(f"{path}: holds {text!r}, which is not the identifier of a run; delete the file, and W&B begins a new run")
    return text


def publish(loggers: Iterable[Logger], run_dir: Path, results: Mapping[str, float]) -> None:
    """Send results and figures of the evaluation to W&B, with animations, or to TensorBoard, if they are among the loggers, and close the run there."""
    from lightning.pytorch.loggers import WandbLogger

    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            for path in sorted(run_dir.glob("*.png")):
                with Image.open(path) as picture:
                    logger.experiment.add_image(path.stem, np.asarray(picture.convert("RGB")), dataformats="HWC")
            logger.log_metrics(dict(results))
            logger.finalize("success")
        if isinstance(logger, WandbLogger):
            import wandb

            run: Any = logger.experiment
            pictures = {path.stem: wandb.Image(str(path)) for path in sorted(run_dir.glob("*.png"))}
            films = {
                f"{path.stem} ({kind})": wandb.Video(str(path), format=kind) for kind in FILMS for path in sorted(run_dir.glob(f"*.{kind}"))
            }
            run.log({**pictures, **films})
            run.summary.update(dict(results))
            is_offline = run.settings.mode == "offline"
            run.finish()
            if is_offline:
                folders = " ".join(map(str, sorted((run_dir / "wandb").glob(f"offline-run-*-{run_id(run_dir)}"))))  # one for every start
                log.warning("W&B: kept offline%s; upload it with `wandb sync %s`", "" if has_key() else ", as there is no API key", folders)

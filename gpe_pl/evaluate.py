"""Command ``python -m gpe_pl.evaluate checkpoint=… split=test_unseen``: evaluate a trained model."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.config.entry_point import ConfigError, construct, construct_target, entry_point
from gpe_pl.config.folder import CONF
from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.schema import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from omegaconf import DictConfig

    from gpe_pl.learned.simulator import LearnedSimulator


def evaluate_checkpoint(cfg: DictConfig) -> None:
    """Roll a trained model out on one split of a data set, and in the data set's showcase if it has one. Results go to ``{paths.runs}/{name}``.

    A split that is missing is generated first. The first printed line says which acceptance checks and stress tests the model fails. Several checkpoints are
    evaluated as one ensemble. With ``calibrate``, error bands are stored beside the first checkpoint; without, their coverage is measured.
    """
    from gpe_pl.config.datasets import (
        check_material_controls,
        check_splits,
        ensure_split,
        evaluated_config,
        material_controls,
        scene_metadata,
        stride_of,
    )
    from gpe_pl.data.checksum import split_checksum
    from gpe_pl.data.frame_velocities import warn_of_means
    from gpe_pl.evaluation.rollouts import as_evaluated, evaluate
    from gpe_pl.evaluation.settings import EvaluationSettings
    from gpe_pl.evaluation.uncertainty import Uncertainty
    from gpe_pl.files.names import run_name
    from gpe_pl.files.run_folder import claim, release, without_orphans
    from gpe_pl.learned.ensemble import LearnedEnsemble, members_of
    from gpe_pl.learned.verdicts import headline
    from gpe_pl.reports.sweep_table import conclusion, report_evaluation
    from gpe_pl.rollout.skips import Skips
    from gpe_pl.system.locks import locked
    from gpe_pl.system.progress import no_bar, progress_bar
    from gpe_pl.system.provenance import recorded
    from gpe_pl.training.run import TrainerSettings, set_up

    checkpoints = _checkpoints(cfg)
    if cfg.evaluation.data or list(cfg.evaluation.splits) != [cfg.split]:
        raise ConfigError("evaluation.data, evaluation.splits: are keys of fit; evaluate takes data=… and split=…, one split in each run")
    settings = construct(EvaluationSettings, {k: v for k, v in cfg.evaluation.items() if k != "data"}, "evaluation")
    evaluated = evaluated_config(cfg)
    check_splits(evaluated, [cfg.split], "split")
    check_material_controls(cfg, settings)
    device = set_up(construct(TrainerSettings, cfg.trainer, "trainer"))
    ensemble = LearnedEnsemble.from_checkpoints(checkpoints, device)
    simulator = ensemble.members[0]
    for checkpoint, member in zip(checkpoints, ensemble.members, strict=True):
        member.skips = construct(Skips, cfg.rollout, "rollout")
        print(headline(checkpoint), flush=True)
    scene = scene_metadata(evaluated, cfg.split)
    if not simulator.fits(scene):
        stride = simulator.stride_on(scene_metadata(evaluated, cfg.split, strided=False))
        simulator.check_scene(scene, f"data.stride={stride}" if stride else _own_data(simulator))
    shown = None if cfg.data.get("showcase") is None else _showcase(cfg, members_of(as_evaluated(simulator, settings))[0])
    folder = Path(cfg.paths.runs) / run_name(cfg.name)
    with locked(folder), recorded(folder, "evaluate", sys.argv[1:], cfg.paths.runs):
        root = ensure_split(evaluated, cfg.split)
        warn_of_means(simulator, root, cfg.split)
        claim(folder, _identity(evaluated, root, simulator), results=["*"])
        with without_orphans(folder):
            try:
                start_frame = settings.first_frame(simulator.builder.config.history, scene.frame_dt)
                controls = material_controls(cfg, settings, root, start_frame, simulator)
                uncertainty = Uncertainty(
                    checkpoints,
                    [member.on(scene) for member in ensemble.members],
                    settings,
                    cfg.split,
                    split_checksum(root, cfg.split),
                    cfg.calibrate,
                )
                evaluated_model = ensemble if len(checkpoints) > 1 else simulator
                stride, bars = stride_of(evaluated), progress_bar if cfg.trainer.progress else no_bar
                evaluate(evaluated_model, root, settings, folder, controls=controls, stride=stride, see=uncertainty.see, bars=bars)
                uncertainty.finish(folder)
            finally:
                release(folder)
        report_evaluation(folder)
        if shown is not None:
            shown(folder)
    print(conclusion(folder))
    print(folder)


def _checkpoints(cfg: DictConfig) -> list[str]:
    """Return the checkpoints that the settings name.

    Raises:
        ConfigError: there are none, or settings do not fit several checkpoints or calibration.
    """
    from gpe_pl.learned.pretrained import names

    given = (
        [cfg.checkpoint]
        if isinstance(cfg.checkpoint, str)
        else list(cfg.checkpoint or [])
        if not isinstance(cfg.checkpoint, int | float)
        else []
    )
    if not given or not all(isinstance(checkpoint, str) for checkpoint in given):
        shipped = f", or a shipped model: {', '.join(names())}" if names() else ""
        raise ConfigError(
            f"checkpoint={cfg.checkpoint!r}: name the folder of a run, such as runs/sand, or a checkpoint{shipped}; or several, as [a,b]"
        )
    if len(given) > 1 and cfg.data.get("showcase") is not None:
        raise ConfigError("data.showcase: rolls out a single model; choose data.showcase=null, or one checkpoint")
    if cfg.split not in SPLITS:
        raise ConfigError(f"split={cfg.split}: must be one of {', '.join(SPLITS)}{did_you_mean(str(cfg.split), SPLITS)}")
    if cfg.calibrate not in (True, False):
        raise ConfigError(f"calibrate={cfg.calibrate!r}: must be true or false")
    if cfg.calibrate and cfg.split == "train":
        raise ConfigError("calibrate=true: needs scenes that the model was not trained on; choose another split than train")
    return given


def _identity(cfg: DictConfig, root: Path, simulator: LearnedSimulator) -> dict[str, Any]:
    """Return the settings and checksums on which the metrics of an evaluation depend. If one of them differs, the evaluation needs another folder."""
    from omegaconf import OmegaConf

    from gpe_pl.data.checksum import split_checksum
    from gpe_pl.files.run_folder import DATA_CHECKSUMS
    from gpe_pl.learned.bands import path_beside
    from gpe_pl.learned.pretrained import fingerprint
    from gpe_pl.training.run import TrainerSettings

    checkpoints = _checkpoints(cfg)
    prints = [fingerprint(checkpoint) for checkpoint in checkpoints]
    beside = path_beside(checkpoints)
    bands = {"calibrate": True} if cfg.calibrate else {"bands": sha256(beside.read_bytes()).hexdigest()[:12]} if beside.is_file() else {}
    values: Any = OmegaConf.to_container(cfg, resolve=True)
    without = ("splits", "data", "num_pictures", "export", "quantities")  # do not change the metrics
    evaluation = {key: value for key, value in values["evaluation"].items() if key not in without}
    return {
        "checkpoint": prints[0] if len(prints) == 1 else prints,
        **bands,
        "model": {"_target_": simulator.description()["model"], "material_embedding": simulator.model.settings.get("material_embedding")},
        "graph": {"history": simulator.builder.config.history},  # where rollouts start
        "split": cfg.split,
        DATA_CHECKSUMS: {cfg.split: split_checksum(root, cfg.split)},
        "evaluation": evaluation,
        **{k: values[k] for k in ("data", "rollout")},
        **construct(TrainerSettings, cfg.trainer, "trainer").identity,
    }


def _own_data(simulator: LearnedSimulator) -> str:
    """Return the overrides that choose data like the training data, for a message; empty if no data set fits."""
    from gpe_pl.config.datasets import IMPORTED, dataset
    from gpe_pl.data.ground_truth import trajectory_metadata

    own = simulator.builder.metadata
    strided = [f"data.stride={simulator.stride}"] if simulator.stride > 1 else []
    if own.solver.startswith("import/"):
        return " ".join([f"data={IMPORTED} data.name={own.dataset}", *strided])
    groups = sorted(path.stem for path in (CONF / "data").glob("*.yaml") if path.stem != IMPORTED and own.dataset.startswith(path.stem))
    for group, size, dimension in product(groups, ("tiny", "small", "paper"), ([], [f"dimension={own.dim}"])):
        overrides = [f"data={group}", f"size={size}", *dimension]
        if simulator.fits(trajectory_metadata(dataset(*overrides), "train", 0).every(simulator.stride)):
            return " ".join([*overrides, *strided])
    return ""


def _showcase(cfg: DictConfig, simulator: LearnedSimulator) -> Callable[[Path], None]:
    """Build the scene of the showcase. Return a function that rolls the simulator out in it and writes the results into a folder.

    The scene is built first so that errors in its settings are reported before the evaluation.

    Raises:
        ConfigError: a setting of ``data.showcase`` is wrong.
    """
    from gpe_pl.evaluation import showcase
    from gpe_pl.system.progress import progress_bar

    if not isinstance(cfg.data.showcase, Mapping):
        raise ConfigError(f"data.showcase={cfg.data.showcase!r}: must be a table with a scene, or null")
    settings = construct(
        showcase.ShowcaseSettings, {k: v for k, v in cfg.data.showcase.items() if k not in {"scene", "suffix"}}, "data.showcase"
    )
    scene = construct_target(cfg.data.showcase.get("scene"), "data.showcase.scene", "gpe_pl.solvers.")
    try:
        state, metadata = showcase.start(simulator, scene, settings)
    except ValueError as error:
        if isinstance(error, GpeError):
            raise
        raise ConfigError(f"data.showcase: {error}") from None

    def show(folder: Path) -> None:
        with progress_bar("showcase") as on_progress:
            records = showcase.run(simulator, state, metadata, settings, folder, on_progress)
        print(showcase.summary(records))

    return show


main = entry_point("evaluate")(evaluate_checkpoint)

if __name__ == "__main__":
    main()

"""Train and evaluate: ``python -m gpe_pl.fit experiment=…``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.config.entry_point import ConfigError, bind, construct, entry_point, num_processes, output_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def fit(cfg: DictConfig) -> float:
    """Generate what data is missing, train or resume, evaluate.

    Returns:
        The mean full-length rollout MSE [m²] on the first split evaluated; failed rollouts count as in tables (``finished_runs.rollout_errors``).
    """
    from gpe_pl.files.names import data_name, run_name
    from gpe_pl.system.locks import held

    data_name(cfg.data.name, "data.name")
    if cfg.reuse is not None:
        run_name(cfg.reuse, "reuse")
    with held(output_dir(cfg), num_processes=num_processes(cfg)):
        return _fit(cfg, output_dir(cfg))


def _fit(cfg: DictConfig, run_dir: Path) -> float:
    from functools import cache

    import lightning as L
    from omegaconf import OmegaConf

    from gpe_pl.data.checksum import split_checksum
    from gpe_pl.data.datamodule import TrajectoryDataModule
    from gpe_pl.data.dataset import open_split, window_counts
    from gpe_pl.data.sampling import BatchSize
    from gpe_pl.evaluation.rollouts import LEARNED, EvaluationSettings, evaluate, means, read_rows
    from gpe_pl.files.run_folder import DATA_CHECKSUMS, RunError, claim, without_tables
    from gpe_pl.graphs.features import GraphConfig
    from gpe_pl.learned.pretrained import fingerprint
    from gpe_pl.learned.simulator import LearnedSimulator, model_class
    from gpe_pl.reports.finished_runs import Run, rollout_errors, table_of
    from gpe_pl.simulate import IMPORTED, ensure_data, evaluated_config, scene_metadata
    from gpe_pl.training.budget import PauseForMeasurements, mean_step_time, step_time_key, within_budget
    from gpe_pl.training.module import TrainingModule
    from gpe_pl.training.run import TrainerSettings, TrainingSettings, adopt, set_up, train
    from gpe_pl.training.tracking import LoggerSettings, publish

    if type(cfg.seed) is not int or cfg.seed < 0:
        raise ConfigError(f"seed={cfg.seed!r}: must be an integer of at least 0")
    if not (cfg.start_from is None or isinstance(cfg.start_from, str)):
        raise ConfigError(f"start_from={cfg.start_from!r}: must be null, the folder of a run, a checkpoint or a shipped model")
    training = construct(TrainingSettings, cfg.training, "training")
    trainer = construct(TrainerSettings, cfg.trainer, "trainer")
    evaluation = construct(EvaluationSettings, {k: v for k, v in cfg.evaluation.items() if k != "data"}, "evaluation")
    graph = construct(GraphConfig, cfg.graph, "graph")
    first_frame = evaluation.first_frame(graph.history)
    logger = construct(LoggerSettings, cfg.logger, "logger")
    new_model = bind(model_class(cfg.model._target_), {k: v for k, v in cfg.model.items() if k != "_target_"}, "model", "spec")
    batch_size = construct(BatchSize, cfg.batching, "batching", num_graphs=training.batch_size)

    start = None if cfg.start_from is None else LearnedSimulator.from_checkpoint(cfg.start_from)
    if start is not None or training.position_noise_of_domain:  # what cannot be trained is said before data are generated
        scenes = scene_metadata(cfg, "train")
        training.noise.check(scenes)
        if start is not None:
            start.check_scene(scenes)

    root = ensure_data(cfg)
    evaluated = ensure_data(evaluated_config(cfg)) if cfg.evaluation.data else root
    device = set_up(trainer)

    @cache
    def data() -> TrajectoryDataModule:
        stress = bool(cfg.model.get("stress", False))
        return TrajectoryDataModule(
            root, graph, training.noise, batch_size, cfg.seed, trainer.num_workers, stress=stress, sampling=training.sampling
        )

    def new_module(training: TrainingSettings) -> TrainingModule:
        L.seed_everything(cfg.seed, verbose=False)
        simulator = LearnedSimulator(new_model(spec=data().builder.spec), data().builder)
        simulator.fit_statistics(data().statistics_sample(), data().parameter_ranges(), data().trained_scene())
        if start is not None:
            simulator.start_from(start)
        names = ("num_steps", "learning_rate", "final_learning_rate", "schedule", "warmup_steps", "stress_weight", "compile")
        return TrainingModule(simulator, **{n: getattr(training, n) for n in names})

    checksums = {split: split_checksum(root, split) for split in ("train", "val")}
    evaluated_checksums = {split: split_checksum(evaluated, split) for split in evaluation.splits}
    resolved: Any = OmegaConf.to_container(cfg, resolve=True)
    settings = without_tables(resolved)
    unusual = {"batching": settings["batching"]} if batch_size.max_nodes is not None else {}  # as runs had it before there was a choice
    callbacks: list[L.Callback] = []
    if training.budget_minutes is not None:
        imported = checksums["train"] if settings["data"]["size"] == IMPORTED else None
        key = step_time_key(settings, training, trainer, imported)
        times = Path(cfg.paths.runs) / (cfg.reuse or cfg.name) / "step_times.json"
        callbacks.append(PauseForMeasurements(times))
        training = within_budget(
            training,
            times,
            key,
            lambda settings: mean_step_time(new_module(settings).to(device), data().train_set, batch_size, settings),
            device,
        )
    settings["training"] = training.as_dict()
    trained = {k: settings[k] for k in ("seed", "size", "data", "graph", "model", "training")} | unusual
    trained |= {} if cfg.start_from is None else {"start_from": fingerprint(cfg.start_from)}
    trained |= {DATA_CHECKSUMS: checksums}
    config = trained | {"evaluation": settings["evaluation"] | {DATA_CHECKSUMS: evaluated_checksums}}
    if evaluation.static_friction and not graph.islands:
        raise ConfigError(f"evaluation.static_friction={evaluation.static_friction:g}: needs graph.islands=true, which model=gpe_tuned has")
    claim(run_dir, config)
    if not (run_dir / "metrics.csv").exists():
        best = None if cfg.reuse is None else adopt(Path(cfg.paths.runs) / cfg.reuse, trained, run_dir)
        for split in evaluation.splits:  # what cannot be evaluated is said before the training, not after it
            window_counts(open_split(evaluated, split, cache_bytes=0), first_frame)
        loggers = logger.loggers(run_dir, cfg.name, config)
        best = best or train(new_module(training), data(), training, trainer, loggers, run_dir, callbacks)
        rows = evaluate(LearnedSimulator.from_checkpoint(best, device), evaluated, evaluation, run_dir)
        publish(loggers, run_dir, means(rows))

    run = Run(run_dir, {}, table_of(read_rows(run_dir / "metrics.csv")))
    values = [value for errors in rollout_errors([run], evaluation.splits[0], "full") for value in errors.values()]
    if not values:
        path = run_dir / "metrics.csv"
        raise RunError(f"{path}: has no rollout_mse of {LEARNED} on {evaluation.splits[0]}; delete the file to evaluate again")
    return sum(values) / len(values)


main = entry_point("fit")(fit)

if __name__ == "__main__":
    main()

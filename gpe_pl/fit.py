"""Train and evaluate: ``python -m gpe_pl.fit experiment=…``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gpe_pl.config import ConfigError, bind, construct, entry_point, output_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def fit(cfg: DictConfig) -> float:
    """Generate what data is missing, train or resume, evaluate; returns the mean full-length rollout MSE [m²] on the first split evaluated."""
    import lightning as L
    from omegaconf import OmegaConf

    from gpe_pl.data.datamodule import TrajectoryDataModule
    from gpe_pl.data.noise import Noise
    from gpe_pl.evaluation import LEARNED, EvaluationSettings, evaluate, read_rows
    from gpe_pl.graphs.features import GraphConfig
    from gpe_pl.learned_simulator import LearnedSimulator, model_class
    from gpe_pl.simulate import ensure_data
    from gpe_pl.training.module import TrainingModule
    from gpe_pl.training.run import LoggerSettings, TrainerSettings, TrainingSettings, claim, set_threads, train

    if type(cfg.seed) is not int or cfg.seed < 0:
        raise ConfigError(f"seed={cfg.seed!r}: must be an integer of at least 0")
    training = construct(TrainingSettings, cfg.training, "training")
    trainer = construct(TrainerSettings, cfg.trainer, "trainer")
    evaluation = construct(EvaluationSettings, cfg.evaluation, "evaluation")
    graph = construct(GraphConfig, cfg.graph, "graph")
    logger = construct(LoggerSettings, cfg.logger, "logger")
    new_model = bind(model_class(cfg.model._target_), {k: v for k, v in cfg.model.items() if k != "_target_"}, "model", "spec")
    noise = Noise(training.noise, training.noise_std)

    run_dir = output_dir(cfg)
    root = ensure_data(cfg)
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    claim(run_dir, {k: settings[k] for k in ("seed", "size", "data", "graph", "model", "training", "evaluation")})
    if not (run_dir / "metrics.csv").exists():
        set_threads(trainer)
        L.seed_everything(cfg.seed, verbose=False)
        datamodule = TrajectoryDataModule(root, graph, noise, training.batch_size, cfg.seed, trainer.num_workers)
        simulator = LearnedSimulator(new_model(spec=datamodule.builder.spec), datamodule.builder)
        simulator.fit_statistics(datamodule.statistics_sample())
        names = ("num_steps", "learning_rate", "final_learning_rate", "schedule", "warmup_steps", "compile")
        module = TrainingModule(simulator, **{n: getattr(training, n) for n in names})
        best = train(module, datamodule, training, trainer, logger.loggers(run_dir), run_dir)
        device = "cuda" if trainer.accelerator == "gpu" else "cpu"
        evaluate(LearnedSimulator.from_checkpoint(best, device), root, evaluation, run_dir)

    values = [
        r.value
        for r in read_rows(run_dir / "metrics.csv")
        if (r.model, r.split, r.metric, r.horizon) == (LEARNED, evaluation.splits[0], "rollout_mse", "full")
    ]
    return sum(values) / len(values)


main = entry_point("fit")(fit)

if __name__ == "__main__":
    main()

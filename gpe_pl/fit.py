"""Command ``python -m gpe_pl.fit experiment=…``: train a model and evaluate it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gpe_pl.config.entry_point import entry_point, num_processes, output_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def fit(cfg: DictConfig) -> float:
    """Generate missing data, train or resume, and evaluate.

    Returns:
        Mean full-length rollout MSE [m²] on the first evaluated split. Failed rollouts count as in tables (``finished_runs.rollout_errors``).
    """
    from gpe_pl.config.fit_run import FitRun
    from gpe_pl.files.names import data_name, run_name
    from gpe_pl.files.run_folder import without_orphans
    from gpe_pl.system.locks import locked
    from gpe_pl.training.parallel import end_later_processes

    data_name(cfg.data.name, "data.name")
    if cfg.reuse is not None:
        run_name(cfg.reuse, "reuse")
    folder = output_dir(cfg)
    with locked(folder, num_processes=num_processes(cfg)):
        run = FitRun(cfg, folder)
        run.prepare_data()
        run.choose_num_steps()
        run.claim_folder()
        with without_orphans(folder):
            if run.is_evaluated:
                end_later_processes()  # they have nothing to report
            else:
                run.check_evaluation()
                run.evaluate(run.finished_model() or run.train())
            return run.error()


main = entry_point("fit")(fit)

if __name__ == "__main__":
    main()

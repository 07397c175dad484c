"""Writes tables and figures of the finished runs or evaluations in a folder.

The command ``python -m gpe_pl.reports FOLDER`` writes them again from stored results, or compares several evaluations.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import one_line, speak_utf8
from gpe_pl.files.run_folder import RunError
from gpe_pl.reports.domain_table import TABLE_MD, compares_models, report_domains
from gpe_pl.reports.evaluation_table import EVALUATIONS_MD, report_evaluations
from gpe_pl.reports.finished_runs import Run, evaluations_below, finished_runs, is_evaluation
from gpe_pl.reports.scale_table import SCALES_MD, compares_scales, report_scales
from gpe_pl.reports.sweep_table import SWEEP_MD, report_sweep
from gpe_pl.reports.trial_table import TRIALS_MD, compares_settings, report_trials
from gpe_pl.system.locks import locked


def write_tables(folder: Path, runs: list[Run]) -> Path:
    """Write tables and figures into the folder of a sweep, or of evaluations. The settings in which its runs differ decide which tables are written.

    Returns:
        Path of the table in Markdown. It does not exist if no run has finished.

    Raises:
        TableError: the runs do not belong in one table (see ``domain_table.report_domains`` and ``scale_table.report_scales``).
    """
    if runs and all(map(is_evaluation, runs)):
        report_evaluations(folder, runs)
        return folder / EVALUATIONS_MD
    if compares_scales(runs):
        report_scales(folder, runs)
        return folder / SCALES_MD
    if compares_settings(runs):
        report_trials(folder, runs)
        return folder / TRIALS_MD
    if compares_models(runs):
        report_domains(folder, runs)
        return folder / TABLE_MD
    report_sweep(folder, runs)
    return folder / SWEEP_MD


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m gpe_pl.reports", description="Write tables and figures of finished runs or evaluations."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of a sweep, such as runs/table1, or of several evaluations")
    folder = parser.parse_args(arguments).folder
    speak_utf8()
    try:
        runs = finished_runs(folder) or evaluations_below(folder)
        if not runs:
            raise RunError(
                f"{folder}: contains no finished run (a folder with config.json and metrics.csv); give the folder of a sweep or run"
            )
        with locked(folder):
            print(write_tables(folder, runs).read_text(encoding="utf-8"))
    except GpeError as error:
        print(f"error: {one_line(str(error))}", file=sys.stderr)
        return 2
    return 0

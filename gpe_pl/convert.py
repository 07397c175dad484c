"""Command ``python -m gpe_pl.convert format=lagrangebench source=FOLDER name=NAME``: import data of other projects, or your own arrays.

The command writes a data set in this package's store. Train on it with ``python -m gpe_pl.fit data=imported data.name=NAME``. The modules of
``gpe_pl.data.importers`` describe the formats; ``--help`` lists the settings. Read the report: trajectories that cannot be used are left out, each with the
reason and the frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gpe_pl.config.entry_point import construct, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


def convert(cfg: DictConfig) -> None:
    """Import one data set and print the report."""
    from gpe_pl.data.importers import CONTACT_SHEET_FILE, PAGE_FILE, ImportSettings, import_dataset
    from gpe_pl.system.progress import progress_bar

    settings = construct(ImportSettings, {str(key): value for key, value in cfg.items() if key != "paths"}, "")
    with progress_bar(f"{settings.format} {settings.name or ''}") as on_progress:
        report = import_dataset(cfg.paths.data, settings, on_progress, contact_sheet=True)
    print(report.text())
    if {"train", "val", "test"} <= set(report.splits):
        print(f"train on it: python -m gpe_pl.fit data=imported data.name={report.name} name={report.name}")
    for name in (CONTACT_SHEET_FILE, PAGE_FILE):
        print(Path(report.folder) / name)


main = entry_point("convert")(convert)

if __name__ == "__main__":
    main()

"""Readers of the field's public formats, which write data sets of the project's own store.

A source is read twice: once to look at every trajectory, so that bounds, materials and spacing of the data set are known and what cannot be used is refused,
and once to write. The data set appears complete or not at all, and an existing one is never touched. Layout::

    {root}/{name}/imported/{split}/shard-00000.h5
    {root}/{name}/imported/statistics.json          of the train split
    {root}/{name}/imported/report.{json,md}         what was found, assumed, repaired and refused
    {root}/{name}/imported/contact_sheet.png        some scenes, to look at, from the command
"""

from gpe_pl.data.importers.assemble import CONTACT_SHEET_FILE, FOLDER, draw_contact_sheet, import_dataset, save_dataset
from gpe_pl.data.importers.report import PAGE_FILE, Report
from gpe_pl.data.importers.source import Format, ImportFailure, ImportSettings, Refusal

__all__ = [
    "CONTACT_SHEET_FILE",
    "FOLDER",
    "PAGE_FILE",
    "Format",
    "ImportFailure",
    "ImportSettings",
    "Refusal",
    "Report",
    "draw_contact_sheet",
    "import_dataset",
    "save_dataset",
]

"""Importers, which convert public data formats to data sets of the store.

A source is read twice. The first pass refuses trajectories that cannot be used, and determines bounds, materials and spacing of the data set. The second pass
writes. The data set appears complete or not at all, and an existing one is never changed. Layout::

    {root}/{name}/imported/{split}/shard-00000.h5
    {root}/{name}/imported/statistics.json          statistics of the train split
    {root}/{name}/imported/report.{json,md}         facts, assumptions, repairs and refusals
    {root}/{name}/imported/contact_sheet.png        some scenes for inspection, drawn by the command
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

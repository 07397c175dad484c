"""Command ``python -m gpe_pl.reports FOLDER``: writes the tables of finished runs again."""

import sys

from gpe_pl.reports.tables import main

if __name__ == "__main__":
    sys.exit(main())

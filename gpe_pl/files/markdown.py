"""Markdown tables."""

from gpe_pl.errors.printable import printable


def table_row(cells: list[str]) -> str:
    """Format cells as one row of a Markdown table."""
    return "| " + " | ".join(map(printable, cells)) + " |"

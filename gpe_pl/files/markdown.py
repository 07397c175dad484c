"""Tables for people, as Markdown."""

from gpe_pl.printable import printable


def table_row(cells: list[str]) -> str:
    """A row of a Markdown table."""
    return "| " + " | ".join(map(printable, cells)) + " |"

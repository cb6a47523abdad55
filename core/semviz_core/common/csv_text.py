"""Tables as CSV in which spreadsheets find no formulas."""

import csv
import io
from collections.abc import Iterable, Sequence

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
"""Spreadsheets take a cell that begins with one of these for a formula; some skip white space."""


def csv_text(rows: Iterable[Sequence[object]], line_end: str = "\n") -> str:
    """Return rows as CSV: None as an empty cell, floats exactly, as ``repr`` writes them.

    Names come from files of others: a text that a spreadsheet would take for a formula stands
    behind an apostrophe.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator=line_end)  # noqa: TID251
    writer.writerows([_guarded(cell) for cell in row] for row in rows)
    return text.getvalue()


def cell_text(cell: str) -> str:
    """Return the text from which ``csv_text`` made a cell."""
    return cell[1:] if cell.startswith("'") and _is_formula(cell) else cell


def _guarded(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and _is_formula(cell) else cell


def _is_formula(text: str) -> bool:
    return text.lstrip("' ").startswith(_FORMULA)

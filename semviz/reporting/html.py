"""HTML that is escaped by construction: text becomes markup nowhere but here."""

from collections.abc import Sequence
from html import escape

from semviz.tables import Table

Attribute = str | int | float | None


class Html(str):
    """Markup. Any other text is escaped where it enters an element."""


def element(name: str, /, *children: str | None, **attributes: Attribute) -> Html:
    """``element("p", "a < b", class_="dim")``; None is left out, names end with _ if reserved."""
    inner = "".join(_markup(child) for child in children if child is not None)
    return Html(f"{_opened(name, attributes)}{inner}</{name}>")


def void_element(name: str, /, **attributes: Attribute) -> Html:
    """One that has no end, such as ``meta``."""
    return Html(_opened(name, attributes))


def table_element(table: Table, first_cells: Sequence[Html] | None = None) -> Html:
    """A table with its title as heading; ``first_cells`` stand in place of the first column."""
    sides = ["words" if column < table.words else "numbers" for column in range(len(table.header))]

    def line(kind: str, cells: Sequence[str]) -> Html:
        paired = zip(cells, sides, strict=True)
        return element("tr", *(element(kind, cell, class_=side) for cell, side in paired))

    rows = table.cells
    if first_cells is not None:
        rows = tuple((first, *row[1:]) for first, row in zip(first_cells, rows, strict=True))
    head = element("thead", line("th", table.header))
    body = element("tbody", *(line("td", row) for row in rows))
    return element("div", element("table", head, body), class_="table")


def _markup(text: str) -> str:
    return text if isinstance(text, Html) else escape(text)


def _opened(name: str, attributes: dict[str, Attribute]) -> str:
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f"<{name}{written}>"

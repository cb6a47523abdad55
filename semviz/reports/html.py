"""Build self-contained HTML pages in which text is escaped by construction."""

from collections.abc import Sequence
from html import escape
from importlib.resources import files

from semviz.presentation.plots import COLORS, STATUS
from semviz.presentation.terminal import Table

Attribute = str | int | float | None


class Html(str):
    """Markup. Any other text is escaped where it enters an element."""


def element(name: str, /, *children: str | None, **attributes: Attribute) -> Html:
    """Return an element: ``element("p", "a < b", class_="dim")``.

    A child or attribute None is left out; ``_`` ends the name of an attribute that is a keyword.
    """
    inner = "".join(_markup(child) for child in children if child is not None)
    return Html(f"{_opened(name, attributes)}{inner}</{name}>")


def void_element(name: str, /, **attributes: Attribute) -> Html:
    """Return an element without end tag, for example ``meta``."""
    return Html(_opened(name, attributes))


def table_element(table: Table, first_cells: Sequence[Html] | None = None) -> Html:
    """Return a table; ``first_cells`` replace its first column."""
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


POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
DARK_SERIES = ("#4BA3E3", "#F08A4B", "#35C79B", "#E39BC4", "#8ACBF2", "#F2B84B", "#E6E7E9")
"""The hues of the plots' colours, for a dark background."""


def html_page(title: str, *content: Html) -> str:
    """Return a page, which runs no script and loads nothing."""
    head = element(
        "head",
        void_element("meta", charset="utf-8"),
        void_element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        void_element("meta", name="viewport", content="width=device-width"),
        element("title", title),
        element("style", Html(_style())),
    )
    body = element("body", *content)
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def table_section(table: Table) -> Html:
    return element("section", element("h2", table.title), table_element(table))


def plot(caption: str, svg: str) -> Html:
    drawn = element("div", Html(svg), class_="plot", role="img", aria_label=caption)
    return element("figure", element("figcaption", caption), drawn)


def _style() -> str:
    """Return the style sheet, with the colours of status and plots."""
    light: dict[str, str] = {status: tone.light for status, tone in STATUS.items()}
    dark: dict[str, str] = {status: tone.dark for status, tone in STATUS.items()}
    light |= {f"series-{number}": color for number, color in enumerate(COLORS)}
    dark |= {f"series-{number}": color for number, color in enumerate(DARK_SERIES)}
    style = files("semviz.reports").joinpath("page.css").read_text()
    return (
        f":root {{{_variables(light)}}}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{{_variables(dark)}}} }}\n"
        f"{style}"
    )


def _variables(colors: dict[str, str]) -> str:
    return " ".join(f"--{name}: {color};" for name, color in colors.items())

"""What every report's page is made of: one HTML file that asks nothing of any other machine."""

from importlib.resources import files

from semviz.palette import STATUS
from semviz.plot_style import COLORS
from semviz.reporting.html import Html, element, table_element, void_element
from semviz.tables import Table

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
DARK_SERIES = ("#4BA3E3", "#F08A4B", "#35C79B", "#E39BC4", "#8ACBF2", "#F2B84B", "#E6E7E9")
"""Of the same hues as the colours of plots on light ground."""


def html_page(title: str, *content: Html) -> str:
    """The whole file. It runs no script."""
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
    """The page's style, with the colours of status and plots."""
    light: dict[str, str] = {status: tone.light for status, tone in STATUS.items()}
    dark: dict[str, str] = {status: tone.dark for status, tone in STATUS.items()}
    light |= {f"series-{number}": color for number, color in enumerate(COLORS)}
    dark |= {f"series-{number}": color for number, color in enumerate(DARK_SERIES)}
    style = files("semviz.reporting").joinpath("page.css").read_text()
    return (
        f":root {{{_variables(light)}}}\n"
        f"@media screen and (prefers-color-scheme: dark) {{ :root {{{_variables(dark)}}} }}\n"
        f"{style}"
    )


def _variables(colors: dict[str, str]) -> str:
    return " ".join(f"--{name}: {color};" for name, color in colors.items())

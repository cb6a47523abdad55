"""Tables as aligned text, Markdown and LaTeX; each format escapes what it must."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_MARKDOWN = re.compile(r"([\\`*\[\]<>|&~$]|(?<!\w)_|_(?!\w))")
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    **{sign: f"\\{sign}" for sign in "{}$&#%_"},
}


@dataclass(frozen=True)
class Table:
    """A title, a header and cells, as plain text."""

    title: str
    header: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    words: int
    """Number of leading columns with words; the others hold numbers."""

    def as_text(self) -> str:
        widths = [max(map(len, column)) for column in zip(self.header, *self.cells, strict=True)]
        header, *lines = (self._line(cells, widths) for cells in (self.header, *self.cells))
        return "\n".join([*filter(None, [self.title]), header, "-" * len(header), *lines])

    def as_markdown(self) -> str:
        sides = [":--" if column < self.words else "--:" for column in range(len(self.header))]
        header, *rows = ([in_markdown(cell) for cell in row] for row in (self.header, *self.cells))
        lines = (" | ".join(cells) for cells in (header, sides, *rows))
        return "\n".join([f"## {in_markdown(self.title)}", "", *(f"| {line} |" for line in lines)])

    def as_latex(self) -> str:
        """Return a ``table`` that needs no LaTeX package."""
        sides = "".join("l" if column < self.words else "r" for column in range(len(self.header)))
        header, *rows = (
            " & ".join(map(in_latex, row)) + r" \\" for row in (self.header, *self.cells)
        )
        body = [r"\hline", header, r"\hline", *rows, r"\hline"]
        return "\n".join(
            [
                r"\begin{table}",
                r"\centering",
                rf"\caption{{{in_latex(self.title)}}}",
                rf"\begin{{tabular}}{{{sides}}}",
                *body,
                r"\end{tabular}",
                r"\end{table}",
            ]
        )

    def _line(self, cells: Sequence[str], widths: list[int]) -> str:
        return "  ".join(
            cell.ljust(width) if column < self.words else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()


def in_markdown(text: str) -> str:
    """Return the text as one line, with markup escaped."""
    return _MARKDOWN.sub(r"\\\1", _one_line(text))


def in_latex(text: str) -> str:
    """Return the text as one line, with commands escaped."""
    return "".join(_LATEX.get(sign, sign) for sign in _one_line(text))


def figure(value: float | None) -> str:
    """Return a number in at most five characters; a dash for None."""
    if value is None:
        return "-"
    if value >= 99999.5:
        return f"{value:.0e}"
    return f"{value:.{max(4 - len(str(int(value))), 0)}f}"


def percent(value: float | None) -> str:
    """Return a share in percent; a dash for None."""
    return "-" if value is None else f"{value:.1%}"


def _one_line(text: str) -> str:
    return " ".join(text.split())

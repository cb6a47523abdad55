"""What commands print: tables, and progress and notices on standard error.

Tables are aligned text, Markdown or LaTeX; each format escapes what it must. Progress bars appear
only on a terminal, and output can be piped. A notice explains a slow first frame while the solver
compiles.
"""

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

Item = TypeVar("Item")


def track(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield ``items``; on a terminal, a bar shows how many of ``total`` are done."""
    from rich.console import Console
    from rich.progress import track as rich_track

    console = Console(stderr=True)
    silent = not console.is_terminal  # keep log files short
    return iter(rich_track(items, description=what, total=total, console=console, disable=silent))


@cache  # register one callback only
def announce_compiling(what: str = "the solver") -> None:
    """Print a notice when ``what`` is compiled, which delays the first frame."""
    from semviz_core.common.jit import notify_before_compiling

    notify_before_compiling(
        lambda: print(f"compiling {what}, once only: up to a minute", file=sys.stderr)
    )


def count_functions(compile_: Callable[[Callable[[int], None]], None]) -> None:
    """Run ``compile_`` with a function that shows on a terminal, in one line, how many functions
    are compiled."""
    shown = False

    def tell(compiled: int) -> None:
        nonlocal shown
        if sys.stderr.isatty():
            shown = True
            print(f"\r{compiled} functions compiled", end="", file=sys.stderr, flush=True)

    compile_(tell)
    if shown:
        print(file=sys.stderr)


class Steps:
    """Progress bars on a terminal, one for each step of a long job; use it with ``with``."""

    def __enter__(self) -> "Steps":
        from rich.console import Console
        from rich.progress import Progress

        console = Console(stderr=True)
        self._bars = Progress(console=console, disable=not console.is_terminal)
        self._tasks: dict[str, Any] = {}
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def show(self, what: str, done: int, of: int) -> None:
        """Show that ``done`` of ``of`` parts of the step ``what`` are done."""
        if what not in self._tasks:
            self._tasks[what] = self._bars.add_task(what, total=of)
        self._bars.update(self._tasks[what], completed=done, total=of)


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

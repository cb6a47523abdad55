"""A report as Markdown or LaTeX: its tables."""

from collections.abc import Sequence

from semviz.reporting.facts import Reported
from semviz.reporting.summary import (
    elements_table,
    faults_table,
    notes,
    tables,
    worst_table,
)
from semviz.tables import Table, in_latex, in_markdown


def as_markdown(reported: Sequence[Reported]) -> str:
    """All tables, below a title."""
    names = ", ".join(one.name for one in reported)
    return (
        "\n\n".join(
            [
                f"# {in_markdown(names)}",
                *(f"Note: {in_markdown(note)}." for note in notes(reported)),
                *(table.as_markdown() for table in _all_tables(reported)),
            ]
        )
        + "\n"
    )


def as_latex(reported: Sequence[Reported]) -> str:
    """Tables to be included in a paper; they need no package."""
    said = [f"% Note: {in_latex(note)}." for note in notes(reported)]
    return "\n\n".join([*said, *(table.as_latex() for table in _all_tables(reported))]) + "\n"


def _all_tables(reported: Sequence[Reported]) -> list[Table]:
    of_each = (worst_table, faults_table, elements_table)
    return [*tables(reported), *(table(one) for one in reported for table in of_each)]

"""A comparison in words and tables."""

from collections.abc import Iterator

from semviz.comparing.comparison import Change, Comparison, FrameChange
from semviz.pose_errors import Errors
from semviz.tables import Table

LISTED = 10
"""So many frames of a kind in the text."""


def as_text(comparison: Comparison) -> str:
    """For people: what differs, how many frames changed, the metrics side by side, which frames."""
    parts = [
        "\n".join(comparison.notes),
        "\n".join(_differences(comparison)),
        _counts(comparison),
        metrics_table(comparison).as_text(),
        *(_frames(comparison, change) for change in ("broken", "fixed")),
    ]
    if comparison.maps is not None:
        parts.append(f"maps, base to other:\n{comparison.maps.as_text()}")
    return "\n\n".join(part for part in parts if part)


def metrics_table(comparison: Comparison) -> Table:
    """Every metric of both runs, and by how much it changed."""
    rows = []
    for name, other in comparison.other.items():
        base = comparison.base[name]
        change = None if base is None or other is None else other - base
        rows.append((name, _number(base), _number(other), "-" if not change else f"{change:+.4g}"))
    return Table("", ("metric", "base", "other", "change"), tuple(rows), words=1)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _differences(comparison: Comparison) -> Iterator[str]:
    for one in comparison.differences:
        yield f"{one.what}: {one.base} -> {one.other}"
    if not comparison.differences:
        yield "made with the same settings and map"


def _counts(comparison: Comparison) -> str:
    counts = {name: int(value or 0) for name, value in comparison.counts.items()}
    return (
        f"{len(comparison.frames)} frames in both: {counts['fixed']} fixed, "
        f"{counts['broken']} broken, {counts['same']} same"
    )


def _frames(comparison: Comparison, change: Change) -> str:
    frames = comparison.of(change)
    lines = [f"{change}:", *(f"  {_frame(one)}" for one in frames[:LISTED])]
    if len(frames) > LISTED:
        lines.append(f"  {len(frames) - LISTED} more; --json lists all")
    return "\n".join(lines) if frames else ""


def _frame(one: FrameChange) -> str:
    base, other = (
        f"{status}{_error(errors)}" for status, errors in zip(one.status, one.errors, strict=True)
    )
    return f"frame {one.index}: {base} -> {other}"


def _error(errors: Errors | None) -> str:
    return "" if errors is None else f" {errors.distance_m:.2f} m"

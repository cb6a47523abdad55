"""Say why the passes think that the map has changed: title, sentence and facts of a change."""

import numpy as np

from semviz.inspector.views_run import EvidenceLine
from semviz_annotation.mapping.passes.changes import Change, MapChanges
from semviz_core.base.semantic_map import footprint_covariance_m2, footprint_m
from semviz_core.common.arrays import IntArray

NEAR_M = 6.0
"""Standing elements up to this distance are shown beside a change."""
MOST_NEAR = 2


def change_title(change: Change) -> str:
    """Return ``Vanished before june-2``."""
    match change.kind:
        case "vanished":
            return f"Vanished before {change.since}"
        case "new":
            return f"New since {change.since}"
        case "moved":
            return f"Moved {change.moved_m:.1f} m before {change.since}"
        case _:
            return "The passes cannot tell"


def change_sentence(found: MapChanges, change: Change) -> str:
    """Return who saw it, and who did not."""
    counts = found.evidence.counts
    match change.kind:
        case "new":
            since = found.passes.index(change.since)
            seen, chances = counts.seen[change.row], counts.chances[change.row]
            saw = _passes(seen[since:], "saw it", seen[since:])
            missed = _missed(seen[:since], chances[:since], "of its place")
            return f"{saw}. Before that, {missed}." if missed else f"{saw}."
        case "moved":
            since = found.passes.index(change.since)
            old = counts.seen[found.row_in_map(change)]
            new = counts.seen[change.row]
            before = _passes(old[:since], "saw it where the map has it", old[:since])
            after = _passes(new[since:], f"see it {change.moved_m:.1f} m away", new[since:])
            return f"{before}. Since then {after}."
        case "vanished":
            since = found.passes.index(change.since)
            seen, chances = counts.seen[change.row], counts.chances[change.row]
            saw = _passes(seen[:since], "saw it", seen[:since])
            return f"{saw}. Since then {_missed(seen[since:], chances[since:])}."
        case _:
            seen, chances = counts.seen[change.row], counts.chances[change.row]
            missed = _missed(seen, chances)
            if not seen.any():
                return f"No pass saw it: {missed}. It may be hidden from this way."
            return f"{_passes(seen, 'saw it', seen)}; {missed}."


def change_facts(found: MapChanges, change: Change) -> tuple[EvidenceLine, ...]:
    """Return the numbers behind a change, at most five."""
    counts, row = found.evidence.counts, change.row
    chances, expected = counts.chances[row].sum(), counts.expected[row].sum()
    rows = []
    if change.kind != "new" and chances:
        missed = 100.0 * (1.0 - min(expected / chances, 1.0))
        rows.append(("A frame with a view misses it", f"{missed:.0f} %"))
    if change.kind == "vanished":
        rows.append(("Gone", _percent(1.0 - change.existence)))
    else:
        where = "Stands at its new place" if change.kind == "moved" else "Exists now"
        rows.append((where, _percent(change.existence)))
    if change.kind in ("new", "moved"):
        sigma_m = np.sqrt(np.trace(footprint_covariance_m2(found.whole[[row]])[0]) / 2.0)
        rows.append(("Place known to", f"± {sigma_m:.2f} m"))
    for other in near_rows(found, change):
        seen, met = (counts.seen[other] > 0).sum(), (counts.chances[other] > 0).sum()
        away_m = np.linalg.norm(np.subtract(*footprint_m(found.whole)[[other, row], :2]))
        name = found.semantic_map.name_of(int(found.whole.id[other]))
        rows.append((f"{name}, {away_m:.1f} m away", f"seen by {seen} of {met} passes"))
    return tuple(EvidenceLine(name=name, value=value) for name, value in rows)


def near_rows(found: MapChanges, change: Change) -> list[int]:
    """Return the rows of the nearest elements of the map that stand and were in view."""
    place_m = footprint_m(found.whole)[:, :2]
    away_m = np.linalg.norm(place_m - np.array(change.place_m[:2]), axis=1)
    away_m[len(found.semantic_map) :] = np.inf
    changed = [each.element_id for each in found.changes if each.element_id is not None]
    away_m[np.isin(found.whole.id, changed)] = np.inf
    away_m[~found.evidence.counts.chances.any(axis=1)] = np.inf
    order = np.argsort(away_m, kind="stable")[:MOST_NEAR]
    return [int(row) for row in order if away_m[row] <= NEAR_M]


def _passes(seen: IntArray, what: str, frames: IntArray) -> str:
    """Return ``3 passes saw it, in 46 frames``."""
    return f"{_counted((seen > 0).sum(), 'pass', 'passes')} {what}, in {_frames(frames.sum())}"


def _missed(seen: IntArray, chances: IntArray, of: str = "of it") -> str:
    """Return ``4 did not, in 58 frames with a view of it``; empty if none had a chance."""
    missed = (seen == 0) & (chances > 0)
    if not missed.any():
        return ""
    return f"{missed.sum()} did not, in {_frames(chances[missed].sum())} with a view {of}"


def _frames(count: int) -> str:
    return _counted(count, "frame", "frames")


def _counted(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"


def _percent(probability: float) -> str:
    if probability > 0.999:
        return "> 99.9 %"
    if probability < 0.001:
        return "< 0.1 %"
    return f"{100.0 * probability:.1f} %"

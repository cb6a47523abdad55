"""Helpers of the map writers: sign plates, and the tally of dropped and assumed content.

The tally is reported to users and scripts.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray

LOG_ODDS = "existence_log_odds"
"""Name of ``Provenance.log_odds`` in files."""
MOST_KINDS = 100
"""Largest number of different entries."""


@dataclass
class ConversionTally:
    """Counts of dropped and assumed content, by what it is and why."""

    dropped: "Counter[str]" = field(default_factory=Counter)
    assumed: "Counter[str]" = field(default_factory=Counter)

    def drop(self, what: str, count: int = 1) -> None:
        _count(self.dropped, what, count)

    def assume(self, what: str, count: int = 1) -> None:
        _count(self.assumed, what, count)


@dataclass(frozen=True)
class ExchangeReport:
    """The result of an export or import."""

    path: str
    format: str
    counts: Mapping[str, int]
    """Counts of exchanged elements, for example ``poles``."""
    dropped: Mapping[str, int]
    """Counts of content that could not be kept."""
    assumed: Mapping[str, int]
    """Counts of values that were unknown and had to be assumed."""

    @classmethod
    def of(
        cls, path: object, format_: str, counts: Mapping[str, int], tally: ConversionTally
    ) -> "ExchangeReport":
        return cls(str(path), format_, dict(counts), dict(tally.dropped), dict(tally.assumed))

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        counts = ", ".join(
            f"{count} {what.removesuffix('s') if count == 1 else what}"
            for what, count in self.counts.items()
        )
        lines = [f"{self.path}: {counts} ({self.format})"]
        lines += [f"  dropped: {count} x {what}" for what, count in sorted(self.dropped.items())]
        lines += [f"  assumed: {count} x {what}" for what, count in sorted(self.assumed.items())]
        return "\n".join(lines)


def _count(counter: "Counter[str]", what: str, count: int) -> None:
    if count:
        known = what in counter or len(counter) < MOST_KINDS
        counter[what if known else "more kinds of things"] += count


PLATE_M = 0.6
"""Width and height of a sign's plate; a map has only the centre of a sign."""


def across_road(semantic_map: SemanticMap) -> FloatArray:
    """Return level unit vectors (n, 3) to the right of the driving direction at each element.

    The direction is that of the step of ``trajectory_m`` that starts nearest to the anchor; without
    a trajectory the result is -y.
    """
    anchors, road = semantic_map.elements.anchor_m, semantic_map.trajectory_m
    steps = np.diff(road[:, :2], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    starts, steps = road[:-1][lengths > 0.0], steps[lengths > 0.0]
    if not len(steps):
        return np.tile([0.0, -1.0, 0.0], (len(anchors), 1))
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(starts[:, :2]).query(anchors[:, :2])
    ahead = steps[nearest] / lengths[lengths > 0.0][nearest, None]
    return np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(anchors))])


def counts(semantic_map: SemanticMap) -> dict[str, int]:
    """Return the numbers of poles and signs of a map."""
    lines = int(semantic_map.elements.is_line.sum())
    return {"poles": lines, "signs": len(semantic_map) - lines}


def drop_all_but_places(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count what a format drops that holds only positions and classes of elements."""
    tally.drop("standard deviations and correlations", len(semantic_map))
    drop_history(semantic_map, tally)
    tally.drop("labels and observations that elements come from", len(semantic_map.provenance))


def drop_history(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count the dropped build history and road."""
    drop_making(semantic_map, tally)
    tally.drop("points of the road that was driven", len(semantic_map.trajectory_m))


def drop_making(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count the dropped content that no other format holds."""
    tally.drop("decisions that the map was built by", len(semantic_map.decisions))
    tally.drop("method, settings and label operation of the map", bool(semantic_map.made_by))


def as_json(value: object) -> str:
    """Return plain values as JSON, numbers with all digits."""
    return json.dumps(value, allow_nan=False)


def unseen_ends(semantic_map: SemanticMap) -> int:
    """Return the number of unknown ends of poles, and of unknown signs."""
    elements = semantic_map.elements
    return int((~elements.anchor_known).sum() + (elements.is_line & ~elements.end_known).sum())

"""All that can be said about how good a map is: what ``semviz map check`` prints."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.accuracy import Accuracy, mapping_accuracy
from semviz_annotation.mapping.quality.labelled import check_frame
from semviz_annotation.mapping.quality.leave_out import LeftOut, leave_one_out
from semviz_annotation.mapping.quality.lint import SEVERITIES, Finding, lint
from semviz_annotation.mapping.quality.linting.case import Case
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source

WORST_LISTED = 5
WORST_KEPT = 100
"""Labels that agree least with the others: so many in the text, and in JSON."""
FINDINGS_LISTED = 10
"""Of each rule and severity, in the text."""
FAR_AWAY_M = 1000.0
POLES_M = (0.1, 100.0)
"""A map whose elements are mostly further from the road, or whose poles are mostly shorter or
longer, is in other units or in another frame."""


@dataclass(frozen=True)
class Check:
    """How good a map is."""

    semantic_map: SemanticMap
    accuracy: Accuracy
    """Without classes where the map was not made from labels."""
    left_out: tuple[LeftOut, ...]
    """Each label against the others of its element, the worst first."""
    findings: tuple[Finding, ...]
    labels_operation: int
    """Number of the labels' last operation."""

    @property
    def is_old(self) -> bool:
        """Whether the labels were changed after the map was built from them."""
        knows = self.semantic_map.operation
        return bool(self.semantic_map.provenance) and knows < self.labels_operation

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            **self.accuracy.as_dict(),
            "lint": [asdict(one) for one in self.findings],
            "leave_out": [asdict(one) for one in self.left_out[:WORST_KEPT]],
            "operations": {"map": self.semantic_map.operation, "labels": self.labels_operation},
        }

    def as_text(self) -> str:
        """The table, the worst labels, and what the rules found."""
        if not self.semantic_map.provenance:
            return "\n".join(["the map was not made from labels: only rules apply", *self._lint()])
        return "\n".join([self.accuracy.as_text(), *self._worst(), *self._lint()])

    def _worst(self) -> Iterator[str]:
        elements, classes = self.semantic_map.elements, self.semantic_map.classes
        class_of = dict(zip(elements.id.tolist(), elements.class_id.tolist(), strict=True))
        yield f"\nlabels that agree least with the others of their element, of {len(self.left_out)}"
        for one in self.left_out[:WORST_LISTED]:
            name = classes.element_name(class_of[one.element_id], one.element_id)
            yield (
                f"  {name:<6} frame {one.frame_index}, {one.side + ':':<6} "
                f"{one.residual_px:6.2f} px ({one.normalized:.1f} sigma)"
            )

    def _lint(self) -> Iterator[str]:
        listed: Counter[tuple[str, str]] = Counter()
        for severity in SEVERITIES:
            mine = [one for one in self.findings if one.severity == severity]
            yield f"\n{severity}s: {len(mine)}"
            for one in mine:
                listed[severity, one.rule] += 1
                if listed[severity, one.rule] <= FINDINGS_LISTED:
                    where = "" if one.frame_index is None else f" [frame {one.frame_index}]"
                    yield f"  {one.rule}: {one.message}{where}"
            for (_, rule), count in listed.items():
                if count > FINDINGS_LISTED:
                    yield f"  {rule}: {count - FINDINGS_LISTED} more; --json lists all"
            listed.clear()


def check_map(
    semantic_map: SemanticMap,
    labels: Labels,
    source: Source,
    frames: Collection[int] | None = None,
) -> Check:
    """Measured in ``frames`` (None: all labelled); the rules look at all of them.

    Raises SemvizError where the map is empty, of another frame or in other units, or a labelled
    frame has no pose.
    """
    _refuse(semantic_map, labels, source)
    if semantic_map.provenance:
        accuracy = mapping_accuracy(semantic_map, labels, source, frames)
    else:
        accuracy = Accuracy(classes={}, elements=len(semantic_map), unmapped=0)
    return Check(
        semantic_map=semantic_map,
        accuracy=accuracy,
        left_out=leave_one_out(semantic_map, labels, source, frames),
        findings=lint(semantic_map, labels, source),
        labels_operation=labels.operation,
    )


def _refuse(semantic_map: SemanticMap, labels: Labels, source: Source) -> None:
    """Raises SemvizError for what is no map of these images."""
    check_frame(semantic_map, source)
    if not len(semantic_map):
        raise SemvizError("the map is empty: label some poles and signs, then 'map build'")
    elements, road = semantic_map.elements, Case(semantic_map, labels, source).road
    why = "is the map in metres, and of this place?"
    if road is not None:
        away_m = float(np.median(road.beside(elements.anchor_m).distance_m))
        if away_m > FAR_AWAY_M:
            raise SemvizError(f"the map's elements are mostly {away_m:.0f} m from the road: {why}")
    if elements.is_line.any():
        poles = elements[elements.is_line]
        length_m = float(np.median(np.linalg.norm(poles.anchor_m - poles.end_m, axis=1)))
        if not POLES_M[0] < length_m < POLES_M[1]:
            raise SemvizError(f"the map's poles are mostly {length_m:g} m long: {why}")

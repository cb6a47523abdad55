"""What became of the labels when a map was built, for people and scripts."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from semviz_annotation.mapping.placing.sightings import Gathered
from semviz_core.semantic_map import Decision, SemanticMap

_MOST_LINES = 12
_MOST_NAMES = 6


@dataclass(frozen=True)
class BuildReport:
    """What became of the labels."""

    decisions: tuple[Decision, ...]
    """As in the map."""
    names: dict[int, str]
    """Of all label elements that were looked at, by number."""
    observations: int
    """That were looked at."""
    used: int
    """That the map is made from."""
    elements: int
    """In the map."""

    @classmethod
    def of(cls, semantic_map: SemanticMap, gathered: Gathered) -> "BuildReport":
        """Of the map that was built from what was gathered."""
        name = semantic_map.classes.element_name
        return cls(
            decisions=semantic_map.decisions,
            names={one.number: name(one.class_id, one.number) for one in gathered.elements},
            observations=len(gathered.observations),
            used=sum(len(one.observation_ids) for one in semantic_map.provenance),
            elements=len(semantic_map),
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "label_elements": len(self.names),
            "observations": self.observations,
            "used": self.used,
            "elements": self.elements,
            "decisions": [asdict(one) for one in self.decisions],
        }

    def __str__(self) -> str:
        return "\n".join([self._summary(), *self._lines()])

    def _summary(self) -> str:
        counts = Counter(one.kind for one in self.decisions)
        return (
            f"{len(self.names)} label elements, {self.used} of {self.observations} observations "
            f"used: {counts['merge']} merged, {counts['apart']} kept apart, {counts['split']} "
            f"split, {counts['leave out']} left out"
        )

    def _lines(self) -> Iterator[str]:
        """One for each decision, but not hundreds of one kind."""
        told: Counter[str] = Counter()
        for one in self.decisions:
            told[one.kind] += 1
            if told[one.kind] <= _MOST_LINES:
                yield f"{_WORDS[one.kind]} {self._names(one)}: {one.reason}"
        for kind, count in told.items():
            if count > _MOST_LINES:
                yield f"{_WORDS[kind]} {count - _MOST_LINES} more"

    def _names(self, one: Decision) -> str:
        names = [self.names[number] for number in one.numbers]
        more = len(names) - _MOST_NAMES
        return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


_WORDS = {"merge": "merged", "apart": "kept apart", "split": "split", "leave out": "left out"}

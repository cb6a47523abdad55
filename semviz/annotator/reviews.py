"""The lists of what waits for a person in the last map: decisions to judge, findings to look at."""

from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

from semviz.annotator.map_work import Built, MapWork
from semviz.reviewing import Json, entry_json, entry_key
from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_annotation.mapping.review import is_open
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import Decision

List: TypeAlias = Literal["decisions", "findings"]


class Reviews:
    """What the page can ask about the last map. One thread at a time."""

    def __init__(self, work: MapWork) -> None:
        self._work = work
        self._built: Built | None = None
        self._open = Open(())
        """Of this map."""

    def summary(self, labels: Labels) -> Json:
        """How much there is, of which map, and whether a new one is being built."""
        built = self._work.built
        return {
            "built": None if built is None else built.semantic_map.operation,
            "elements": 0 if built is None else len(built.semantic_map),
            "decisions": len(self._decisions(built, labels)),
            "findings": 0 if built is None else len(built.findings),
            "building": self._work.building,
            "failure": self._work.failure,
        }

    def card(self, asked: Json, labels: Labels) -> Json:
        """The entry of a list that lies ``by`` places after the one with ``key``.

        Where that one is answered, what followed it is at ``place`` now. ``{"list", "count"}``
        alone where the list is empty. Raises SemvizError where there is no such list.
        """
        name, key, place, by = (asked.get(one) for one in ("list", "key", "place", "by"))
        if name not in get_args(List) or not isinstance(place, int) or by not in (-1, 0, 1):
            raise SemvizError("not a list of this page; reload it")
        built = self._work.built
        entries: Sequence[Decision | Finding] = self._decisions(built, labels)
        if name == "findings" and built is not None:
            entries = built.findings
        if not entries or built is None:
            return {"list": name, "count": 0}
        keys = [entry_key(one) for one in entries]
        at = keys.index(key) + by if key in keys else place + min(by, 0)
        at = min(max(at, 0), len(entries) - 1)
        card = entry_json(entries[at], built.semantic_map, labels)
        return card | {"list": name, "place": at, "count": len(entries)}

    def _decisions(self, built: Built | None, labels: Labels) -> tuple[Decision, ...]:
        if built is not self._built:
            self._built = built
            self._open = Open(() if built is None else built.semantic_map.decisions)
        return self._open.of(labels)


class Open:
    """Which of some decisions are open, as labels change: an edit bears on a few of thousands."""

    def __init__(self, decisions: Sequence[Decision]) -> None:
        self._decisions = decisions
        self._about: dict[str, list[int]] = {}
        """Places of the decisions about each label element."""
        for place, one in enumerate(decisions):
            for element_id in one.label_ids:
                self._about.setdefault(element_id, []).append(place)
        self._labels = Labels()
        self._open: set[int] = set()

    def of(self, labels: Labels) -> tuple[Decision, ...]:
        """In their order."""
        for element_id in labels.differing(self._labels):
            for place in self._about.get(element_id, ()):
                if is_open(self._decisions[place], labels):
                    self._open.add(place)
                else:
                    self._open.discard(place)
        self._labels = labels
        return tuple(self._decisions[place] for place in sorted(self._open))

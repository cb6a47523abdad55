"""Several kinds of labelled images as one: to learn from streets and from labels together."""

from dataclasses import dataclass
from typing import Any

from semviz_core.detection.labelled import LabelledImage, LabelledImages


@dataclass(frozen=True)
class JoinedImages:
    """Images of each kind in turn, so that few of one kind count as much as many of another."""

    kinds: tuple[LabelledImages, ...]

    @property
    def count(self) -> int:
        return len(self.kinds) * max(one.count for one in self.kinds)

    @property
    def held_out_count(self) -> int:
        return len(self.kinds) * max(one.held_out_count for one in self.kinds)

    def image(self, number: int) -> LabelledImage:
        row, kind = divmod(number, len(self.kinds))
        return self.kinds[kind].image(row % self.kinds[kind].count)

    def held_out(self, number: int) -> LabelledImage:
        row, kind = divmod(number, len(self.kinds))
        return self.kinds[kind].held_out(row % self.kinds[kind].held_out_count)

    def describe(self) -> dict[str, Any]:
        return {"in_turn": [one.describe() for one in self.kinds]}

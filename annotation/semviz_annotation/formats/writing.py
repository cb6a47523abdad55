"""What the writers share: which images there are, what stands in each, and what is lost."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from semviz_annotation.labels import Labels
from semviz_annotation.rows import Observation
from semviz_core.camera import Camera, Rig
from semviz_core.classes import ClassSet
from semviz_core.sources.source import Side

SIDES: tuple[Side, Side] = ("left", "right")
ATTRIBUTES: Mapping[str, Mapping[str, Literal["text", "checkbox"]]] = {
    "line": {"element": "text", "anchor_known": "checkbox", "end_known": "checkbox"},
    "point": {"element": "text", "anchor_known": "checkbox"},
}
"""What is said of a pole and of a sign beside where it is."""


@dataclass(frozen=True)
class Sheet:
    """One image with its labels."""

    frame_index: int
    side: Side
    width: int
    height: int
    observations: tuple[Observation, ...]

    @property
    def stem(self) -> str:
        return f"{self.frame_index:06d}"

    @property
    def name(self) -> str:
        """What the image is called, as readers understand it."""
        return f"{self.side}/{self.stem}.png"


@dataclass(frozen=True)
class Writing:
    """All that is written, and what the format cannot say."""

    labels: Labels
    classes: ClassSet
    sheets: tuple[Sheet, ...]
    dropped: "Counter[str]"
    side: Side | None = None
    """The only side that is written; None for both."""

    @classmethod
    def of(cls, labels: Labels, classes: ClassSet, rig: Rig, side: Side | None = None) -> "Writing":
        """Every image of a frame that has labels or a review; of one ``side`` only, if given."""
        cameras: dict[Side, Camera | None] = {"left": rig.left, "right": rig.right}
        sheets = tuple(
            Sheet(frame, one, camera.width, camera.height, labels.in_frame(frame, one))
            for frame in sorted({*labels.frames, *labels.reviews})
            for one in SIDES
            if (camera := cameras[one]) is not None and side in (None, one)
        )
        dropped: Counter[str] = Counter()
        dropped["reviews of frames: the format has no word for them"] = len(labels.reviews)
        dropped["proposals turned down: the format has no word for them"] = len(labels.dismissals)
        dropped["decisions for map building: the format has no word for them"] = len(
            labels.judgements
        )
        written = sum(len(sheet.observations) for sheet in sheets)
        other = "right" if side == "left" else "left"
        dropped[f"labels of {other} images: export them with --side {other}"] = (
            len(labels.observations) - written
        )
        return cls(labels, classes, sheets, +dropped, side)

    def class_name(self, row: Observation) -> str:
        return self.classes[self.labels.element(row.element_id).class_id].name


def as_word(value: bool) -> str:
    return "true" if value else "false"

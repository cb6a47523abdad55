"""What a detector leaves: a proposal for each pole or sign, and the record of processed images.

By the record, an image without a proposal is one without a detection, or one not processed.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_annotation.labels.rows import Index, Pixel, derived_id
from semviz_core.base.classes import (
    OLDER_CENTER,
    SIGMA_RATIO,
    TRIANGULAR,
    TriangleCenter,
    describe_center,
)
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

Setting = str | int | float | bool | None


@dataclass(frozen=True)
class Proposal:
    """One proposed pole or sign in one image."""

    id: str
    """Also the id of the observation that it becomes when it is accepted."""
    frame_index: int
    side: Side
    class_id: int
    anchor_px: Pixel
    end_px: Pixel | None
    """None for signs."""
    anchor_known: bool
    end_known: bool
    """False for signs."""
    score: float
    """0..1; its meaning depends on the detector."""
    sigma_px: float
    """Standard deviation of a sign's centre along each axis, or of a pole's ends across it."""
    sigma_along_px: float | None = None
    """Standard deviation of a pole's ends along it; None if unknown, and for signs."""
    detector: str = ""
    """Name of the detector, if known."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the point of a triangular sign is."""
    to_centroid_px: float | None = None
    """As in ``Elements2D``; None if unknown."""

    def following(self, triangle_center: TriangleCenter) -> "Proposal":
        """Return the proposal as it is by another definition; its id stays.

        Raise SemvizError if it is a triangular sign of unknown height.
        """
        if triangle_center == self.triangle_center or self.class_id != TRIANGULAR:
            return replace(self, triangle_center=triangle_center)
        if self.to_centroid_px is None:
            raise SemvizError(
                f"frame {self.frame_index}, {self.side}: a proposed triangular sign is "
                f"{describe_center(self.triangle_center)} and its height is not known, but "
                f"{describe_center(triangle_center)} is needed; give to_centroid_px, or "
                "detect again"
            )
        to = 1.0 if triangle_center == "centroid" else -1.0
        return replace(
            self,
            anchor_px=(self.anchor_px[0], self.anchor_px[1] + to * self.to_centroid_px),
            sigma_px=self.sigma_px * SIGMA_RATIO**to,
            triangle_center=triangle_center,
        )


def proposal_content_id(
    frame_index: int, side: Side, class_id: int, anchor_px: Pixel, end_px: Pixel | None
) -> str:
    """Return the id of a proposal, derived from its content."""
    return derived_id(f"proposal {(frame_index, side, class_id, anchor_px, end_px)!r}")


@dataclass(frozen=True)
class ProcessedImages:
    """The last detector that ``semviz detect`` ran, and the images it has processed so far."""

    detector: str
    """Name of the detector, as in its proposals."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """Settings that its detections depend on."""
    images: frozenset[tuple[int, Side]] = frozenset()
    """Frame index and side of each processed image."""

    def as_json(self) -> str:
        frames = {
            side: sorted(index for index, image_side in self.images if image_side == side)
            for side in ("left", "right")
        }
        document = _ProcessedImagesFile(detector=self.detector, settings=self.settings, **frames)
        return document.model_dump_json()

    @classmethod
    def from_json(cls, text: str | bytes) -> "ProcessedImages":
        """Read the text of ``as_json``. Raise SemvizError if it is invalid."""
        try:
            document = _ProcessedImagesFile.model_validate_json(text)
        except ValidationError:
            raise SemvizError("its record of processed images is not readable") from None
        left: set[tuple[int, Side]] = {(index, "left") for index in document.left}
        right: set[tuple[int, Side]] = {(index, "right") for index in document.right}
        return cls(document.detector, document.settings, frozenset(left | right))


class _ProcessedImagesFile(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    detector: Annotated[str, Field(min_length=1, max_length=100)]
    settings: dict[str, Setting]
    left: list[Index]
    right: list[Index]

"""One proposal of a detector: a pole or sign in one image, with its score and sigma."""

from dataclasses import dataclass, replace

from semviz_annotation.labels.rows import Pixel, derived_id
from semviz_core.base.classes import TRIANGULAR
from semviz_core.base.frame import Side
from semviz_core.base.triangle_center import OLDER, SIGMA_RATIO, TriangleCenter, describe
from semviz_core.common.errors import SemvizError


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
    triangle_center: TriangleCenter = OLDER
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
                f"{describe(self.triangle_center)} and its height is not known, but "
                f"{describe(triangle_center)} is needed; give to_centroid_px, or detect again"
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

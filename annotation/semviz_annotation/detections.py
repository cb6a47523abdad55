"""What a detector finds in an image, as proposals; and back, as a localizer takes it."""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.proposals import Proposal, Proposals, id_of
from semviz_annotation.rules import MIN_LENGTH_PX
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D
from semviz_core.sources.source import Side


def as_proposals(
    frame_index: int, side: Side, elements: Elements2D, camera: Camera, detector: str
) -> tuple[Proposal, ...]:
    """What ``detector`` found in an image; the same find has always the same id.

    Points outside the image are moved to its border, and poles that nothing is left of fall away.
    """
    inside = _inside(elements, camera)
    ids: dict[str, Proposal] = {}
    for row in range(len(inside)):
        one = _proposal(frame_index, side, inside, row, detector)
        ids.setdefault(one.id, one)
    return tuple(ids.values())


def as_elements(proposals: Sequence[Proposal]) -> Elements2D:
    """Proposals of one image as a localizer takes them."""
    found = Proposals.of(proposals)
    along_px = np.where(np.isnan(found.sigma_along_px), found.sigma_px, found.sigma_along_px)
    return Elements2D(
        anchor_px=found.anchor_px,
        end_px=found.end_px,
        class_id=found.class_id,
        score=found.score,
        sigma_px=np.column_stack([found.sigma_px, along_px]),
        anchor_known=found.anchor_known,
        end_known=found.end_known,
    )


def _inside(elements: Elements2D, camera: Camera) -> Elements2D:
    """The elements with their points in the image, without those too short to be any."""
    last_px = (camera.width - 1.0, camera.height - 1.0)
    moved = Elements2D(
        anchor_px=np.clip(elements.anchor_px, 0.0, last_px),
        end_px=np.clip(elements.end_px, 0.0, last_px),
        class_id=elements.class_id,
        score=elements.score,
        sigma_px=np.clip(elements.sigma_px, 0.01, 1000.0),
        anchor_known=elements.anchor_known,
        end_known=elements.end_known,
    )
    length_px = np.linalg.norm(moved.end_px - moved.anchor_px, axis=1)
    return moved[~(length_px < MIN_LENGTH_PX)]


def _proposal(
    frame_index: int, side: Side, elements: Elements2D, row: int, detector: str
) -> Proposal:
    is_line, class_id = bool(elements.is_line[row]), int(elements.class_id[row])
    (anchor_u, anchor_v), (end_u, end_v) = elements.anchor_px[row], elements.end_px[row]
    anchor_px, end_px = (float(anchor_u), float(anchor_v)), (float(end_u), float(end_v))
    across_px, along_px = map(float, elements.sigma_px[row])
    return Proposal(
        id=id_of(frame_index, side, class_id, anchor_px, end_px if is_line else None),
        frame_index=frame_index,
        side=side,
        class_id=class_id,
        anchor_px=anchor_px,
        end_px=end_px if is_line else None,
        anchor_known=bool(elements.anchor_known[row]),
        end_known=bool(elements.end_known[row]),
        score=float(elements.score[row]),
        sigma_px=across_px,
        sigma_along_px=along_px if is_line else None,
        detector=detector,
    )

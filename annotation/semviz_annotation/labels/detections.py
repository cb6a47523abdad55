"""Conversion of an image's detections to proposals, and of proposals back to Elements2D.

Ids are deterministic: the same detection always has the same id.
"""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.labels.proposals import Proposal, Proposals, proposal_content_id
from semviz_annotation.labels.rows import MIN_LENGTH_PX
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side


def as_proposals(
    frame_index: int, side: Side, elements: Elements2D, camera: Camera, detector: str
) -> tuple[Proposal, ...]:
    """Return the detections of ``detector`` in an image as proposals, without duplicates.

    Points outside the image move to its border; poles that become too short are dropped.
    """
    inside = _inside(elements, camera)
    ids: dict[str, Proposal] = {}
    for row in range(len(inside)):
        proposal = _proposal(frame_index, side, inside, row, detector)
        ids.setdefault(proposal.id, proposal)
    return tuple(ids.values())


def as_elements(proposals: Sequence[Proposal]) -> Elements2D:
    """Return the proposals of one image as input of a localizer."""
    table = Proposals.of(proposals)
    along_px = np.where(np.isnan(table.sigma_along_px), table.sigma_px, table.sigma_along_px)
    return Elements2D(
        anchor_px=table.anchor_px,
        end_px=table.end_px,
        class_id=table.class_id,
        score=table.score,
        sigma_px=np.column_stack([table.sigma_px, along_px]),
        anchor_known=table.anchor_known,
        end_known=table.end_known,
    )


def _inside(elements: Elements2D, camera: Camera) -> Elements2D:
    """Return the elements with their points moved into the image, without too short poles."""
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
        id=proposal_content_id(frame_index, side, class_id, anchor_px, end_px if is_line else None),
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

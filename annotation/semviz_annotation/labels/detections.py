"""Conversion of an image's detections to proposals, and of proposals back to Elements2D.

Ids are deterministic: the same detection always has the same id.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.labels.proposal import Proposal, proposal_content_id
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.labels.rows import MIN_LENGTH_PX
from semviz_core.base.camera import Camera
from semviz_core.base.classes import OLDER_CENTER, TriangleCenter
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError


def as_proposals(
    frame_index: int,
    side: Side,
    elements: Elements2D,
    camera: Camera,
    detector: str,
    triangle_center: TriangleCenter = OLDER_CENTER,
) -> tuple[Proposal, ...]:
    """Return the detections of ``detector`` in an image as proposals, without duplicates.

    The elements follow ``triangle_center``. Points outside the image move to its border; poles that
    become too short are dropped.
    """
    inside = _inside(elements, camera)
    ids: dict[str, Proposal] = {}
    for row in range(len(inside)):
        proposal = _proposal(frame_index, side, inside, row, detector)
        ids.setdefault(proposal.id, replace(proposal, triangle_center=triangle_center))
    return tuple(ids.values())


def as_elements(proposals: Sequence[Proposal], triangle_center: TriangleCenter) -> Elements2D:
    """Return the proposals of one image as input of a localizer, following ``triangle_center``.

    Raise SemvizError if a triangular sign follows another definition and has no known height.
    """
    return _elements(Proposals.of([row.following(triangle_center) for row in proposals]))


def _elements(table: Proposals) -> Elements2D:
    along_px = np.where(np.isnan(table.sigma_along_px), table.sigma_px, table.sigma_along_px)
    return Elements2D(
        anchor_px=table.anchor_px,
        end_px=table.end_px,
        class_id=table.class_id,
        score=table.score,
        sigma_px=np.column_stack([table.sigma_px, along_px]),
        anchor_known=table.anchor_known,
        end_known=table.end_known,
        to_centroid_px=table.to_centroid_px,
    )


def calibrated(detections: Proposals, calibration: DetectorCalibration) -> Proposals:
    """Return detections with calibrated scores and sigmas.

    Raise SemvizError if the calibration was made for another detector.
    """
    processed = detections.processed
    if processed is None or not calibration.is_of(processed.settings):
        raise SemvizError(
            f"the calibration is of {calibration.detector}, but the detections are not; build the "
            "map again with 'semviz map build --from detections'"
        )
    elements = calibration.calibrated(_elements(detections))
    along_px = np.where(np.isnan(detections.sigma_along_px), np.nan, elements.sigma_px[:, 1])
    return replace(
        detections,
        score=elements.score,
        sigma_px=elements.sigma_px[:, 0],
        sigma_along_px=along_px,
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
        to_centroid_px=elements.to_centroid_px,
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
        to_centroid_px=None if np.isnan(sixth := elements.to_centroid_px[row]) else float(sixth),
    )

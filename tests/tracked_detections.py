"""A street with a perfect detector, one false pole in plain sight, and the map of its tracks."""

from collections import defaultdict
from dataclasses import replace

import numpy as np

from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.mapping.association.detection_tracks import TrackOptions
from semviz_annotation.mapping.build import BuildOptions, settings_of
from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import Provenance, SemanticMap
from semviz_core.simulation.street import Street

FALSE = 900
"""Number of the false pole in the map."""
NEAR_M = 30.0


def detect_and_map(
    workspace: Workspace, frames: range, track_frames: range | None = None
) -> dict[int, list[Proposal]]:
    """Save proposals and the map of their tracks; return the detections of each map element.

    The map knows those of ``track_frames`` only; None: all.
    """
    street = workspace.street
    found: dict[int, list[Proposal]] = defaultdict(list)
    for index in frames:
        for side in ("left", "right"):
            seen, ids = street.labels(index, side)
            kept = np.isin(ids, _near(street, index)) & seen.anchor_known
            kept &= seen.end_known | ~seen.is_line
            exact = replace(seen[kept], score=np.full(kept.sum(), 0.9))
            rows = as_proposals(index, side, exact, street.rig.left, "true", "centroid")
            for element, row in zip(ids[kept].tolist(), rows, strict=True):
                found[element].append(row)
            found[FALSE] += _false(street, index, side)
    truth = street.truth_map.elements
    false_m = false_pole(street)
    rows = [np.flatnonzero(truth.id == element)[0] for element in found if element != FALSE]
    elements = Elements3D.from_ends(
        [*truth.id[rows], FALSE],
        [*truth.anchor_m[rows], false_m[0]],
        [*truth.end_m[rows], false_m[1]],
        [*truth.class_id[rows], POLE],
    )
    order = np.argsort(elements.id)
    save_proposals(
        Proposals.of([row for rows in found.values() for row in rows]), workspace.proposals_path
    )
    saved = SemanticMap(
        elements=elements[order],
        frame=street.map_frame,
        settings=settings_of(BuildOptions(), None, TrackOptions()),
        provenance=tuple(
            _provenance(found[element], track_frames or frames)
            for element in elements.id[order].tolist()
        ),
    )
    save_map(saved, workspace.map_path(MAIN))
    return found


def track_id(detections: list[Proposal]) -> str:
    return derived_id(f"track {detections[0].id}")


def false_pole(street: Street) -> np.ndarray:
    """(2, 3) m: 15 m ahead of the first frame, over the middle of the road."""
    pose = street.frames[0].T_map_camera
    assert pose is not None
    return pose.apply(np.array([[0.4, -2.0, 15.0], [0.4, 1.0, 15.0]]))


def _false(street: Street, index: int, side: str) -> list[Proposal]:
    ends = street.view(index, side).project(false_pole(street))
    if not street.rig.left.contains(ends).all():
        return []
    return [
        Proposal(
            id=derived_id(f"false {index} {side}"),
            frame_index=index,
            side=side,
            class_id=POLE,
            anchor_px=tuple(ends[0].tolist()),
            end_px=tuple(ends[1].tolist()),
            anchor_known=True,
            end_known=True,
            score=0.5,
            sigma_px=1.0,
            sigma_along_px=1.0,
            detector="true",
        )
    ]


def _near(street: Street, index: int) -> np.ndarray:
    elements = street.truth_map.elements
    away_m = np.linalg.norm(elements.anchor_m - street.view(index, "left").center_m, axis=1)
    return elements.id[away_m < NEAR_M]


def _provenance(detections: list[Proposal], frames: range) -> Provenance:
    used = [row.id for row in detections if row.frame_index in frames]
    return Provenance((track_id(detections),), tuple(used), 9.0)

"""What a page sends when somebody draws: a pole and signs on the first frames of a street."""

import json
from typing import Any

import numpy as np

from semviz.annotator.messages import ApplyEditRequest
from semviz.annotator.page_session import HANDLERS
from semviz.annotator.session import LabelSession, SavedEdit
from semviz_annotation.labels.labels import new_id
from semviz_core.base.classes import POLE, ROUNDED
from semviz_core.base.pose import Pose

PEAK, BOTTOM = np.array([[3.0, -1.2, 14.0]]), np.array([[3.0, 1.6, 14.0]])
"""A pole in the coordinates of frame 0's left camera."""


def pixel(session: LabelSession, point: np.ndarray, frame: int, side: str) -> tuple[float, float]:
    """Where a point of frame 0's left camera is in any image."""
    rig = session.rig
    first, now = (session.frames[index].T_map_camera for index in (0, frame))
    assert first is not None
    assert now is not None
    assert rig.T_right_left is not None
    T_camera_left = Pose.identity() if side == "left" else rig.T_right_left
    u, v = rig.left.project((T_camera_left @ now.inverse() @ first).apply(point))[0]
    return float(u), float(v)


def pole(
    session: LabelSession,
    frame: int,
    side: str,
    selected: str | None = None,
    shift_px: tuple[float, float] = (0.0, 0.0),
    **more: Any,
) -> dict[str, Any]:
    def place(point: np.ndarray) -> list[float]:
        u, v = pixel(session, point, frame, side)
        return [u + shift_px[0], v + shift_px[1]]

    return {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": side,
        "class_id": POLE,
        "anchor_px": place(PEAK),
        "end_px": place(BOTTOM),
        "anchor_known": True,
        "end_known": True,
        "selected_id": selected,
    } | more


def sign(frame: int, side: str, middle: tuple[float, float], **more: Any) -> dict[str, Any]:
    return {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": side,
        "class_id": ROUNDED,
        "anchor_px": list(middle),
        "end_px": None,
        "anchor_known": True,
        "end_known": False,
        "selected_id": None,
    } | more


def do(
    session: LabelSession,
    edit: dict[str, Any],
    request_id: str | None = None,
    base: dict[str, Any] | None = None,
) -> SavedEdit:
    """Does an edit as a page sends it; ``base`` is what the page had shown."""
    sent = {"type": "apply_edit", "id": request_id or new_id(), "edit": edit, "base": base}
    request = HANDLERS.decode(json.dumps(sent))
    assert isinstance(request, ApplyEditRequest)
    return session.apply(request.id, request.edit, request.base)


def draw(session: LabelSession, edit: dict[str, Any]) -> str:
    done = do(session, edit)
    assert done.element_id is not None
    return done.element_id

"""The image panel: the right image, neighbouring frames; and the 3D pane as PNG.

Detections are those of the left image. The viser client in the browser renders the PNG.
"""

import base64
import threading

import numpy as np

from semviz.inspector import views_frame
from semviz.inspector.context import Panel
from semviz.inspector.messages import RenderSceneRequest, SetImageRequest
from semviz.inspector.state import Selection, State, matched_elements
from semviz.inspector.views import SceneImageEvent, pixel, place
from semviz.runs.images import Projected, project_elements
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import error_event, handles
from semviz.web.shapes import PALETTES, rgb
from semviz_core.base.camera import Rig
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError

NEIGHBOURS = 2
"""Number of frames shown before and after."""


class ImagePanel(Panel):
    """Sends the right image and the neighbouring frames while they are shown."""

    def on_frame(self) -> None:
        self._send_right()
        self._send_neighbours()

    def on_state(self) -> None:
        self._send_neighbours()

    @handles(SetImageRequest)
    def _set_image(self, request: SetImageRequest) -> None:
        state, run = self.context.state, self.context.run
        if request.side == "right" and run.info.rig.right is None:
            raise SemvizError("this run has one camera; there is no right image")
        neighbours = state.neighbours if request.neighbours is None else request.neighbours
        mode, side = request.mode or state.mode, request.side or state.side
        self.context.state = state.with_image(mode, side, neighbours)
        self.context.send_state()
        self._send_right()

    def _send_right(self) -> None:
        if self.context.state.side == "right":
            position = self.context.state.position
            mapped = right_view(self.context.run, position)
            self.context.send(views_frame.RightImageEvent(position=position, mapped=mapped))

    def _send_neighbours(self) -> None:
        if self.context.state.neighbours:
            frames = neighbours_view(self.context.run, self.context.state)
            self.context.send(views_frame.NeighboursEvent(frames=frames))


def right_view(run: Run, position: int) -> tuple[views_frame.RightMapped, ...]:
    """Project each row of the submap into the right image."""
    record = run.frames[position]
    estimate, truth = record.localization.T_camera_map, _true_pose(record)
    estimated, true = (_in_right(record, run.info.rig, pose) for pose in (estimate, truth))
    rows = range(len(record.localization.submap))
    return tuple(
        views_frame.RightMapped(estimate=place(estimated, row), truth=place(true, row))
        for row in rows
    )


def _in_right(record: FrameRecord, rig: Rig, T_camera_map: Pose | None) -> Projected | None:
    if T_camera_map is None or rig.right is None or rig.T_right_left is None:
        return None
    submap = record.localization.submap
    return project_elements(submap, rig.T_right_left @ T_camera_map, rig.right)


def neighbours_view(run: Run, state: State) -> tuple[views_frame.NeighbourView, ...]:
    """Return the frames around the state's, with the selected element as detected and as mapped.

    The map is projected with the estimate of each frame, or else with its true pose.
    """
    first, last = (
        max(0, state.position - NEIGHBOURS),
        min(len(run.frames) - 1, state.position + NEIGHBOURS),
    )
    return tuple(_neighbour(run, position, state) for position in range(first, last + 1))


def _neighbour(run: Run, position: int, state: State) -> views_frame.NeighbourView:
    record, selection = run.frames[position], state.selection
    observed = selection.observed if position == state.position else None
    if observed is None:
        observed = _observed_row(run, position, selection)
    return views_frame.NeighbourView(
        position=position,
        seen=None if observed is None else _seen(record.localization, observed),
        mapped=_mapped(run, record, selection.element),
    )


def _observed_row(run: Run, position: int, selection: Selection) -> int | None:
    """Return the detection that matches the selected element, or else truly is it."""
    record, element = run.frames[position], selection.element
    if element is None:
        return None
    matched = (i for i, id in matched_elements(run, position).items() if id == element)
    true = np.flatnonzero(record.element_id == element).tolist()
    return next(matched, next(iter(true), None))


def _seen(localization: Localization, row: int) -> views_frame.PlacedElement:
    observed = localization.observed
    end = pixel(observed.end_px[row]) if observed.is_line[row] else None
    ends = pixel(observed.anchor_px[row]), end
    return views_frame.PlacedElement(class_id=int(observed.class_id[row]), place=ends)


def _mapped(run: Run, record: FrameRecord, element: int | None) -> views_frame.PlacedElement | None:
    elements = run.semantic_map.elements
    rows = np.flatnonzero(elements.id == element)
    pose = record.localization.T_camera_map or _true_pose(record)
    if not len(rows) or pose is None:
        return None
    selected = elements[rows[:1]]
    ends = place(project_elements(selected, pose, record.localization.camera), 0)
    if ends is None:
        return None
    return views_frame.PlacedElement(class_id=int(selected.class_id[0]), place=ends)


def _true_pose(record: FrameRecord) -> Pose | None:
    truth = record.frame.T_map_camera
    return None if truth is None else truth.inverse()


MAX_SIZE_PX = 8192


class RenderPanel(Panel):
    """Renders the 3D pane in the browser, which is slow: each image has a thread of its own."""

    @handles(RenderSceneRequest)
    def _render(self, request: RenderSceneRequest) -> None:
        threading.Thread(target=self._send, args=(request,), daemon=True).start()

    def _send(self, request: RenderSceneRequest) -> None:
        """Send the image, or the reason why there is none."""
        try:
            png = base64.b64encode(self._png(request.width, request.height)).decode()
            self.context.send(SceneImageEvent(reply_to=request.id, png=png))
        except SemvizError as error:
            self.context.send(error_event(error, request.id))

    def _png(self, width: int, height: int) -> bytes:
        if not 0 < min(width, height) <= max(width, height) <= MAX_SIZE_PX:
            raise SemvizError(
                f"{width} × {height} px is too small or too large; choose 1 to {MAX_SIZE_PX} px"
            )
        image = self.context.scene.render(width, height)
        return png_on(image, PALETTES[self.context.state.theme].scene)


def png_on(rgba: ByteImage, background: str) -> bytes:
    """Return an image (h, w, 4) with transparency on a background colour, as PNG."""
    import cv2

    alpha = rgba[:, :, 3:] / 255.0
    image = alpha * rgba[:, :, :3] + (1.0 - alpha) * np.array(rgb(background))
    return cv2.imencode(".png", image[:, :, ::-1].round().astype(np.uint8))[1].tobytes()

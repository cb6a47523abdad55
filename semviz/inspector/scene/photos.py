"""The photo of a frame in 3D: on the far plane of its camera, or behind all that it sees.

Browsers take two pictures to decode a photo. So those of the frames before and after are in the
scene too, hidden: a step shows another one.
"""

from contextlib import suppress
from pathlib import Path

import numpy as np

from semviz.inspector.scene.poses import photographer, vehicle
from semviz.inspector.session import View
from semviz.recording.pictures import picture
from semviz.recording.run import Run
from semviz.web.scene import BACKDROP_DEPTH_M, FRUSTUM_DEPTH_M, Scene
from semviz_core.arrays import ByteImage
from semviz_core.errors import SemvizError

PHOTOS = "/photos"
"""All names of them in the scene begin so."""
HELD = 3
"""The frame's own, and one on each side."""


class Photos:
    """Of one run, which is in the file ``path``."""

    def __init__(self, scene: Scene, run: Run, path: Path) -> None:
        self._scene = scene
        self._run = run
        self._path = path
        self._is_backdrop = False
        self._held: dict[str, tuple[int, ByteImage]] = {}
        """Position of its frame, and the photo, by name in the scene."""

    def show(self, position: int, view: View) -> bool:
        """The photo of the frame at ``position`` and no other; whether there is one."""
        if self._is_backdrop != (view == "camera"):
            self._is_backdrop = not self._is_backdrop
            self._scene.remove_under(PHOTOS)
            self._held.clear()
        for name in self._held:
            self._scene.clear(name)
        return self._draw(position, visible=True)

    def expect(self, position: int) -> None:
        """Those beside ``position``, hidden. It takes its time."""
        for near in (position + 1, position - 1):
            if 0 <= near < len(self._run.frames):
                with suppress(SemvizError):  # broken: that is told at its frame
                    self._draw(near, visible=False)

    def _draw(self, position: int, visible: bool) -> bool:
        record, image = self._run.frames[position], self._image(position)
        pose = vehicle(record) if self._is_backdrop else photographer(record)
        if image is None or pose is None:
            return False
        depth_m = BACKDROP_DEPTH_M if self._is_backdrop else FRUSTUM_DEPTH_M
        camera = record.localization.camera
        self._scene.draw_image(_name(position), pose, camera, depth_m, image, visible)
        return True

    def _image(self, position: int) -> ByteImage | None:
        """The same object each time, as long as it is held."""
        name = _name(position)
        if name not in self._held or self._held[name][0] != position:
            encoded = picture(self._run, self._path, position, "left")
            if encoded is None:
                return None
            self._held[name] = position, _decoded(encoded, half=not self._is_backdrop)
        return self._held[name][1]


def _name(position: int) -> str:
    return f"{PHOTOS}/{position % HELD}"


def _decoded(encoded: bytes, half: bool) -> ByteImage:
    """A frustum shows its image small: half the size is enough there, and quicker."""
    import cv2

    image = cv2.imdecode(
        np.frombuffer(encoded, dtype=np.uint8),
        cv2.IMREAD_REDUCED_COLOR_2 if half else cv2.IMREAD_COLOR,
    )
    if image is None:
        raise SemvizError("the image of this frame is broken; localize again")
    return np.asarray(image[:, :, ::-1], dtype=np.uint8)

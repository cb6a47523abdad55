"""The 3D pane as a picture: drawn by the page's own viser, at any size."""

import base64
import threading

import numpy as np

from semviz.inspector.topic import Topic, Verbs, whole
from semviz.web.colors import PALETTES, rgb
from semviz.web.sessions import Message
from semviz_core.arrays import ByteImage
from semviz_core.errors import SemvizError

LARGEST_PX = 8192


class RenderTopic(Topic):
    """The browser takes its time to draw, so each picture has a thread of its own."""

    def verbs(self) -> Verbs:
        return {"render": self._render}

    def _render(self, message: Message) -> None:
        size = whole(message, "width") or 0, whole(message, "height") or 0
        threading.Thread(target=self._tell, args=size, daemon=True).start()

    def _tell(self, width: int, height: int) -> None:
        """Tells the page of the picture, or why there is none."""
        try:
            png = base64.b64encode(self._png(width, height)).decode()
            self.desk.say("render", {"png": png, "why": ""})
        except SemvizError as error:
            self.desk.say("render", {"png": "", "why": str(error)})

    def _png(self, width: int, height: int) -> bytes:
        if not 0 < min(width, height) <= max(width, height) <= LARGEST_PX:
            size = f"{width} × {height} px"
            raise SemvizError(f"{size} is not from 1 to {LARGEST_PX} px; take it smaller")
        drawn = self.desk.scene.picture(width, height)
        return png_on(drawn, PALETTES[self.desk.state.theme].scene)


def png_on(drawn: ByteImage, ground: str) -> bytes:
    """A picture (h, w, 4) with transparency, on a ground of one colour, as PNG."""
    import cv2

    share = drawn[:, :, 3:] / 255.0
    image = share * drawn[:, :, :3] + (1.0 - share) * np.array(rgb(ground))
    return cv2.imencode(".png", image[:, :, ::-1].round().astype(np.uint8))[1].tobytes()

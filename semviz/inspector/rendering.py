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
        width, height = whole(message, "width"), whole(message, "height")
        if width is None or height is None or not 0 < min(width, height) <= LARGEST_PX:
            raise SemvizError(f"a picture needs a width and a height from 1 to {LARGEST_PX} px")
        threading.Thread(target=self._draw, args=(width, height), daemon=True).start()

    def _draw(self, width: int, height: int) -> None:
        """Tells the page of the picture, or why there is none."""
        try:
            drawn = self.desk.scene.picture(width, height)
            png = png_on(drawn, PALETTES[self.desk.state.theme].scene)
            self.desk.say("render", {"png": base64.b64encode(png).decode(), "why": ""})
        except SemvizError as error:
            self.desk.say("render", {"png": "", "why": str(error)})


def png_on(drawn: ByteImage, ground: str) -> bytes:
    """A picture (h, w, 4) with transparency, on a ground of one colour, as PNG."""
    import cv2

    share = drawn[:, :, 3:] / 255.0
    image = share * drawn[:, :, :3] + (1.0 - share) * np.array(rgb(ground))
    return cv2.imencode(".png", image[:, :, ::-1].round().astype(np.uint8))[1].tobytes()

"""The 3D pane's own verbs: colours of the map, ellipsoids, and viewpoints of a person's own."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np

from semviz.inspector.scene.ellipsoids import MAGNIFIED
from semviz.inspector.session import State
from semviz.inspector.topic import Topic, Verbs
from semviz.web.sessions import Message
from semviz.web.viewpoint import Viewpoint
from semviz_core.arrays import FloatArray, float_array
from semviz_core.errors import SemvizError

SHOWN_S = 0.1
"""So long is waited until a frame is seen: what the next one needs must not delay it."""


class SpaceTopic(Topic):
    """Says what the map's colours mean whenever they, the run or the theme are others."""

    def verbs(self) -> Verbs:
        return {"colors": self._colors, "viewpoint": self._viewpoint, "stand": self._stand}

    def on_run(self) -> None:
        self._tell_legend()

    def on_theme(self) -> None:
        self._tell_legend()

    def on_drawn(self) -> None:
        ahead = threading.Timer(SHOWN_S, self._expect, args=(self.desk.state,))
        ahead.daemon = True
        ahead.start()

    def _expect(self, drawn: State) -> None:
        """In a thread of its own."""
        desk = self.desk
        with desk.lock:
            if (desk.state.run, desk.state.position) == (drawn.run, drawn.position):
                desk.scene.expect_photos(desk.state)

    def _colors(self, message: Message) -> None:
        """What is not told stays."""
        desk, state = self.desk, self.desk.state
        shown = bool(message.get("ellipsoids", state.ellipsoids))
        desk.state = state.coloring(str(message.get("colors", state.colors)), shown)
        desk.tell_state()
        desk.scene.recolor(desk.run, desk.state)
        self._tell_legend()

    def _tell_legend(self) -> None:
        desk = self.desk
        magnified = MAGNIFIED if desk.state.ellipsoids else None
        desk.say("coloring", {**desk.scene.legend(desk.state), "magnified": magnified})

    def _viewpoint(self, _: Message) -> None:
        """Where the person looks from, for the page to keep under a name."""
        now = self.desk.scene.viewpoint()
        self.desk.say("viewpoint", {"eye": _rounded(now.eye_m), "target": _rounded(now.target_m)})

    def _stand(self, message: Message) -> None:
        """Looks from where the page has kept."""
        desk = self.desk
        place = Viewpoint(_point(message.get("eye")), _point(message.get("target")))
        if np.linalg.norm(place.eye_m - place.target_m) < 1e-3:
            raise SemvizError("this viewpoint looks at itself; delete it and keep it anew")
        desk.state = replace(desk.state, view="free")
        desk.tell_state()
        desk.scene.stand(place, desk.run, desk.state)


def _rounded(point_m: FloatArray) -> list[float]:
    return [round(one, 3) for one in point_m.tolist()]


def _point(value: Any) -> FloatArray:
    try:
        return float_array(value, (3,), "viewpoint")
    except (SemvizError, TypeError, ValueError):
        raise SemvizError("a viewpoint is an eye and a target of three numbers each") from None

"""The ways of a run in 3D, and a mark at each frame, which leads to it."""

import numpy as np

from semviz.inspector.scene.poses import estimate, vehicle
from semviz.palette import STATUS
from semviz.recording.run import FrameRecord, Run
from semviz.web.colors import mix
from semviz.web.nodes import PointShape
from semviz.web.picking import Offer, Picker
from semviz.web.scene import Scene
from semviz_core.arrays import FloatArray
from semviz_core.localization import Status
from semviz_core.pose import Pose

WAYS = "/ways"
"""All names of them in the scene begin so."""
MARKS: dict[Status, PointShape] = {"ok": "circle", "ambiguous": "diamond", "cannot": "sparkle"}
"""As near as viser comes to the status marks: disc, diamond, cross."""
MARK_M = 0.6


def draw_ways(scene: Scene, run: Run) -> None:
    """True and estimated camera centres, with gaps where there is none, and the frames' marks."""
    palette = scene.palette
    truth = _centers([one.frame.T_map_camera for one in run.frames])
    found = _centers([estimate(one) for one in run.localizations])
    scene.draw_path(f"{WAYS}/truth", truth, mix(palette.truth, palette.scene, 0.5), 1.0)
    scene.draw_path(f"{WAYS}/estimate", found, mix(palette.estimate, palette.scene, 0.8), 1.2)
    places = mark_places(run)
    for status, shape in MARKS.items():
        rows = [one.status == status for one in run.localizations]
        tone = STATUS[status]
        color = tone.dark if scene.theme == "dark" else tone.light
        scene.draw_points(f"{WAYS}/{status}", places[rows], color, MARK_M, shape)


def offer_frames(picker: Picker, run: Run) -> None:
    """A click on a mark gives the position of its frame in the run."""
    places = mark_places(run)
    picker.offer("frame", Offer(np.arange(len(places)), places, places))


def mark_places(run: Run) -> FloatArray:
    """(frames, 3) where each frame's mark is: the estimate, else the truth, else the prior."""
    return np.array([_mark(one) for one in run.frames]).reshape(-1, 3)


def _mark(record: FrameRecord) -> FloatArray:
    return vehicle(record).translation


def _centers(poses: list[Pose | None]) -> FloatArray:
    """(k, 3), NaN where there is no pose."""
    nowhere = np.full(3, np.nan)
    return np.array([nowhere if one is None else one.translation for one in poses]).reshape(-1, 3)

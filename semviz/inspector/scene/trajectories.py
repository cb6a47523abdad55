"""The ways of a run in 3D, and a mark at each frame, which leads to it."""

from collections.abc import Sequence

import numpy as np

from semviz.inspector.scene.poses import estimate, vehicle
from semviz.palette import STATUS
from semviz.recording.run import Run
from semviz.web.colors import mix
from semviz.web.nodes import PointShape
from semviz.web.picking import Offer, Picker
from semviz.web.scene import CAMERA_HEIGHT_M, Scene
from semviz_core.arrays import FloatArray
from semviz_core.localization import Status
from semviz_core.pose import Pose

WAYS = "/ways"
"""All names of them in the scene begin so."""
MARKS: dict[Status, PointShape] = {"ok": "circle", "ambiguous": "diamond", "cannot": "sparkle"}
"""As near as viser comes to the status marks: disc, diamond, cross."""
MARK_M = 0.3
BELOW_M = np.array([0.0, 0.0, CAMERA_HEIGHT_M - 0.3])
"""Ways and marks lie so far below the cameras, above the road, where they hide no frustum."""


def draw_ways(scene: Scene, run: Run) -> None:
    """True and estimated camera centres, with gaps where there is none, and the frames' marks."""
    palette = scene.palette
    truth = _below([one.frame.T_map_camera for one in run.frames])
    found = _below([estimate(one) for one in run.localizations])
    scene.draw_path(f"{WAYS}/truth", truth, mix(palette.truth, palette.scene, 0.5))
    scene.draw_path(f"{WAYS}/estimate", found, mix(palette.estimate, palette.scene, 0.8))
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
    """(frames, 3) below the estimate, else the truth, else the prior of each frame."""
    return _below([vehicle(one) for one in run.frames])


def _below(poses: Sequence[Pose | None]) -> FloatArray:
    """(k, 3) below the cameras, NaN where there is no pose."""
    places = np.full((len(poses), 3), np.nan)
    for row, pose in enumerate(poses):
        if pose is not None:
            places[row] = pose.translation - BELOW_M
    return places

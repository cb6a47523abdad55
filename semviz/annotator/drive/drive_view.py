"""The view "Your drive": the checks of the import as pictures, and what to do, in order."""

from pathlib import Path
from typing import Literal

import numpy as np

from semviz.web import protocol
from semviz.web.protocol import Part
from semviz.workspace.drive.drive_check_file import (
    CHECKS,
    DriveCheck,
    DriveChecks,
    StepErrors,
    read_checks,
)
from semviz.workspace.poses.pose_review import known_check
from semviz.workspace.workspace import Workspace
from semviz_core.base.camera import Camera
from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.datasets.own_drive.checks import match_checks
from semviz_core.datasets.own_drive.checks.line_checks import bent_edges
from semviz_core.datasets.rig_cameras import camera_names, cameras_by_frame, frames_of_camera

MOST_MATCHES = 400
"""Drawn in a picture."""
MOST_DEPTH_M = 300.0
_REACH_PX = 20.0
"""Matches farther off their line are wrong matches."""


class DriveFact(Part):
    """A figure with what it counts."""

    value: str
    label: str


class DriveStep(Part):
    """Something to do; ``command`` is for a terminal, ``view`` a view of the page."""

    title: str
    text: str
    command: str = ""
    view: Literal["", "images", "poses"] = ""


class DriveView(Part):
    """All of the view but its picture."""

    title: str
    sentence: str
    is_sound: bool
    facts: list[DriveFact]
    checks: list[DriveCheck]
    steps: list[DriveStep]
    frames: list[int]
    """Of the first camera, with a pose, as the trajectory shows them."""
    places_m: list[tuple[float, float]]
    """East and north, or x and y, of each."""
    without_pose: int
    motion: StepErrors | None
    """Of the poses, against the images: all of them if they were measured, else the import's."""
    file: str
    """That keeps the checks; empty if there is none."""


class DriveMatch(Part):
    """A match between the two images of a picture, and its distance (px) from its line."""

    here: tuple[float, float]
    there: tuple[float, float]
    off_px: float
    depth_m: float | None
    """In the first image; None beyond what can be measured."""


class DriveEdge(Part):
    """A long edge in an image, and how far its middle is from the line between its ends."""

    first: tuple[float, float]
    middle: tuple[float, float]
    last: tuple[float, float]
    bend_px: float


class DrivePair(Part):
    """Two images of a drive, and what was measured in them."""

    frame: int
    second: int
    """Frame of the second image."""
    matches: list[DriveMatch]
    edges: tuple[list[DriveEdge], list[DriveEdge]]
    note: str = ""
    """Why there are no matches."""


class ShowDriveRequest(protocol.Request):
    """Request the checks of the drive's import, and what to do."""

    type: Literal["show_drive"] = "show_drive"


class ShowDriveFrameRequest(protocol.Request):
    """Request matches and edges of the images of a frame; a ``drive_frame`` event follows."""

    type: Literal["show_drive_frame"] = "show_drive_frame"
    frame: int


class DriveEvent(protocol.Event):
    """The checks of the drive's import, and what to do."""

    type: Literal["drive"] = "drive"
    drive: DriveView


class DriveFrameEvent(protocol.Event):
    """Matches and edges of the left image of a frame and its right one, or the next one."""

    type: Literal["drive_frame"] = "drive_frame"
    pair: DrivePair


def drive_view(workspace: Workspace, source: Dataset) -> DriveView:
    """Return the view of a workspace with these images and poses.

    Raise SemvizError if the file of checks is damaged.
    """
    path = workspace.path / CHECKS
    stored = read_checks(path) or DriveChecks(checks=())
    measured = known_check(workspace)
    frames = frames_of_camera(source, None)
    posed = [frame for frame in frames if frame.T_map_camera is not None]
    failed = [check for check in stored.checks if check.passed is False]
    places = np.array([_center(frame) for frame in posed]).reshape(-1, 3)
    title = "Your drive can be labelled"
    title += ", but not mapped: it has no poses." if not posed else "."
    if failed:
        title += f" {_NUMBERS.get(len(failed), str(len(failed)))} first."
    told = [check.warning for check in failed] + list(stored.warnings)
    nothing = "All checks passed." if stored.checks else "It was not checked at an import."
    return DriveView(
        title=title,
        sentence=_sentence(told) or nothing,
        is_sound=not told,
        facts=_facts(source, frames, places),
        checks=list(stored.checks),
        steps=[
            *(_repair(check) for check in failed),
            *_usual_steps(workspace.path, source, bool(posed)),
        ],
        frames=[frame.index for frame in posed],
        places_m=[(round(x, 2), round(y, 2)) for x, y in places[:, :2].tolist()],
        without_pose=len(frames) - len(posed),
        motion=stored.steps if measured is None else StepErrors.of(measured),
        file=str(path) if path.is_file() else "",
    )


_NUMBERS = {1: "One step", 2: "Two steps", 3: "Three steps"}


def _sentence(texts: list[str]) -> str:
    return " ".join(f"{text[0].upper()}{text[1:].rstrip('.')}." for text in texts)


def _center(frame: Frame) -> FloatArray:
    assert frame.T_map_camera is not None
    return frame.T_map_camera.translation


def _facts(source: Dataset, frames: tuple[Frame, ...], places: FloatArray) -> list[DriveFact]:
    length_m = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    length = f"{length_m / 1000.0:.1f} km" if length_m >= 1000.0 else f"{length_m:.1f} m"
    seconds = frames[-1].time_s - frames[0].time_s
    names, camera = camera_names(source), source.rig.left
    count = len(names) or (1 if source.rig.right is None else 2)
    of = "frames each" if names else "frames"
    time = f"in {seconds:.1f} s" if seconds < 90.0 else f"in {seconds / 60.0:.0f} min"
    size = f"{camera.width} \u00d7 {camera.height}"
    facts = [
        DriveFact(value=f"{len(frames)}", label=of),
        DriveFact(value=length, label=time),
        DriveFact(value=f"{count} camera{'s' * (count > 1)}", label=size),
    ]
    if source.rig.right is not None:
        facts.append(DriveFact(value=f"{source.rig.baseline_m:.3f} m", label="baseline"))
    return facts


_REPAIRS = {
    "sides": "Exchange left and right",
    "mosaic": "Read the raw images' colours",
    "colors": "Swap red and blue",
    "lines": "Correct the distortion",
    "rows": "Refine the extrinsics",
    "poses": "Correct the poses",
    "mount": "Correct where the camera is",
    "extrinsics": "Refine the extrinsics",
    "scale": "Compare scale and baseline",
    "time": "Correct the times",
    "steps": "Refine poses, or leave them out",
    "gaps": "Look at the gap",
}


def _repair(check: DriveCheck) -> DriveStep:
    return DriveStep(
        title=_REPAIRS[check.kind],
        text=f"{check.warning[0].upper()}{check.warning[1:]}.",
        command=check.remedy,
        view="poses" if check.kind in ("poses", "steps") and not check.remedy else "",
    )


def _usual_steps(path: Path, source: Dataset, has_poses: bool) -> list[DriveStep]:
    count = len(source.frames)
    steps = [
        DriveStep(
            title="Have a detector look",
            text=f"{count} frames. What it finds waits as proposals.",
            command=f"semviz detect {path}",
        ),
        DriveStep(
            title="Label",
            text="One click takes a whole pole or a sign; one key its proposal in the other image.",
            view="images",
        ),
    ]
    if has_poses:
        steps.append(
            DriveStep(
                title="Build the map",
                text="From what is labelled in two images or more.",
                command=f"semviz map build {path}",
            )
        )
    return steps


def drive_pair(source: Dataset, index: int) -> DrivePair:
    """Return matches and edges of the left image of a frame and a second one.

    Of a pair the second is the right image, and lines are rows; else it is the next image of the
    camera, and lines follow from the poses.
    """
    if source.rig.right is not None:
        return _stereo_pair(source, source.rig.right, index)
    camera = source.rig.left
    frames = frames_of_camera(source, cameras_by_frame(source).get(index))
    rank = [frame.index for frame in frames].index(index)
    here, there = frames[rank], frames[min(rank + 1, len(frames) - 1)]
    first = source.image(here.index, "left")
    if here is there or here.T_map_camera is None or there.T_map_camera is None:
        note = f"frame {index}: no next image with a pose to compare it with"
        edges = _edges(first, camera)
        return DrivePair(frame=index, second=index, matches=[], edges=(edges, edges), note=note)
    second = source.image(there.index, "left")
    places = match_checks.matched_pixels(first, second)
    T_there_here = there.T_map_camera.inverse() @ here.T_map_camera
    off_px = match_checks.off_epipolar_lines(camera, places, T_there_here)
    depth_m, _ = match_checks.depths_by_motion(camera, places, T_there_here)
    near = np.abs(off_px) < _REACH_PX
    return DrivePair(
        frame=index,
        second=there.index,
        matches=_thinned(places[near], off_px[near], depth_m[near]),
        edges=(_edges(first, camera), _edges(second, camera)),
    )


def _stereo_pair(source: Dataset, right: Camera, index: int) -> DrivePair:
    first, second = source.image(index, "left"), source.image(index, "right")
    places = match_checks.matches_near_rows(first, second)
    rays = [
        camera.normalize(places[:, side])[:, 0]
        for side, camera in enumerate((source.rig.left, right))
    ]
    depth_m = source.rig.baseline_m / np.maximum(rays[0] - rays[1], 1e-9)
    return DrivePair(
        frame=index,
        second=index,
        matches=_thinned(places, match_checks.rows_apart(places), depth_m),
        edges=(_edges(first, source.rig.left), _edges(second, right)),
    )


def _edges(image: ByteImage, camera: Camera) -> list[DriveEdge]:
    return [
        DriveEdge(
            first=edge.first_px, middle=edge.middle_px, last=edge.last_px, bend_px=edge.bend_px
        )
        for edge in bent_edges(image, camera)
    ]


def _thinned(places: FloatArray, off_px: FloatArray, depth_m: FloatArray) -> list[DriveMatch]:
    step = max(1, len(places) // MOST_MATCHES)
    return [
        DriveMatch(
            here=(here[0], here[1]),
            there=(there[0], there[1]),
            off_px=off,
            depth_m=depth if 0.0 < depth < MOST_DEPTH_M else None,
        )
        for (here, there), off, depth in zip(
            places[::step].round(2).tolist(),
            off_px[::step].round(3).tolist(),
            depth_m[::step].round(2).tolist(),
            strict=True,
        )
    ]

"""Drives past poles and signs as arrays, with the truth beside them."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.common.arrays import BoolArray, FloatArray

K = np.array([[720.0, 0.0, 610.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]])
BASE = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in a map with x forward and z up."""
BASELINE_M = 0.54


@dataclass(frozen=True, eq=False)
class Drive:
    """What was seen from ``views`` (the poses that one believes) on a straight road."""

    views: ViewArray
    true_views: ViewArray
    observations: ObservationArray
    anchor_m: FloatArray
    """(n, 3)"""
    end_m: FloatArray
    """(n, 3), NaN for signs"""

    @property
    def is_line(self) -> BoolArray:
        """(n,)"""
        return np.isfinite(self.end_m[:, 0])


def drive(
    frames: int = 6,
    *,
    landmarks: int = 6,
    seed: int = 0,
    sigma_px: float = 0.0,
    step_m: float = 2.0,
    hidden: float = 0.0,
    pose_sigma: tuple[float, float] = (0.0, 0.0),
    offset_px: float = 0.0,
    reach_m: float = 45.0,
) -> Drive:
    """Every other landmark is a pole; a share of bottoms is ``hidden``, so cut off somewhere.

    ``pose_sigma`` (m, rad) is how far the given poses are off; right images are shifted by
    ``offset_px``.
    """
    rng = np.random.default_rng(seed)
    true_poses = np.tile(BASE, (frames, 1, 1))
    centers = np.column_stack([step_m * np.arange(frames), np.zeros(frames), np.full(frames, 1.65)])
    true_views = stereo(true_poses, centers)
    turn = Rotation.from_rotvec(rng.normal(0.0, 1.0, (frames, 3)) * pose_sigma[1]).as_matrix()
    given = stereo(turn @ true_poses, centers + rng.normal(0.0, 1.0, (frames, 3)) * pose_sigma[0])
    anchor, end = furniture(rng, landmarks, 12.0, 22.0 + step_m * frames)
    shown = replace(true_views, K=true_views.K + offset_px * true_views.is_right[:, None, None] * U)
    observations = seen(rng, shown, anchor, end, sigma_px, hidden, reach_m)
    return Drive(given, true_views, observations, anchor, end)


U = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""What shifts an image by a pixel to the right, added to K."""


def stereo(rotations: FloatArray, centers_m: FloatArray) -> ViewArray:
    """From left cameras' rotations (f, 3, 3, camera to map) and centres (f, 3)."""
    f = len(centers_m)
    R = np.repeat(rotations.transpose(0, 2, 1), 2, axis=0)
    centers = np.repeat(centers_m, 2, axis=0)
    centers[1::2] += BASELINE_M * rotations[:, :, 0]
    t = -(R @ centers[:, :, None])[:, :, 0]
    is_right = np.tile([False, True], f)
    return ViewArray(np.repeat(np.arange(f), 2), is_right, R, t, np.tile(K, (2 * f, 1, 1)))


def furniture(
    rng: np.random.Generator, landmarks: int, first_m: float, last_m: float
) -> tuple[FloatArray, FloatArray]:
    """Anchors (n, 3) and ends (n, 3): poles and signs in turn, on both sides of the road."""
    along = np.linspace(first_m, last_m, landmarks)
    across = rng.uniform(4.0, 9.0, landmarks) * rng.choice([-1.0, 1.0], landmarks)
    anchor = np.column_stack([along, across, rng.uniform(2.0, 5.0, landmarks)])
    end = anchor + rng.normal(0.0, 0.1, (landmarks, 3))
    end[:, 2] = rng.uniform(0.0, 0.4, landmarks)
    end[1::2] = np.nan
    return anchor, end


def seen(
    rng: np.random.Generator,
    views: ViewArray,
    anchor_m: FloatArray,
    end_m: FloatArray,
    sigma_px: float,
    hidden: float,
    reach_m: float,
) -> ObservationArray:
    """All that is from 3 to ``reach_m`` ahead of a camera, whatever the size of its image."""
    n, v = len(anchor_m), len(views)
    landmark, view = (
        axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(v), indexing="ij")
    )
    is_line = np.isfinite(end_m[landmark, 0])
    ahead = views.depth_m(view, anchor_m[landmark])
    rows = (ahead > 3.0) & (ahead < reach_m)
    landmark, view, is_line = landmark[rows], view[rows], is_line[rows]
    a, e = pixels(views, view, anchor_m[landmark]), pixels(views, view, end_m[landmark])
    cut = is_line & (rng.random(len(landmark)) < hidden)
    e = np.where(cut[:, None], a + rng.uniform(0.3, 0.9, (len(landmark), 1)) * (e - a), e)
    noise = rng.normal(0.0, 1.0, (2, len(landmark), 2)) * sigma_px
    return ObservationArray(
        landmark=landmark,
        view=view,
        anchor_px=a + noise[0],
        end_px=e + noise[1],
        anchor_known=np.ones(len(landmark), dtype=bool),
        end_known=is_line & ~cut,
        sigma_ratio=np.ones((len(landmark), 2)),
        label_row=np.arange(len(landmark)),
        count=n,
    )


def pixels(views: ViewArray, rows: FloatArray, points_m: FloatArray) -> FloatArray:
    """(k, 2) of points (k, 3) in the views of rows (k,)."""
    P = views.projection[rows]
    x = (P[:, :, :3] @ points_m[:, :, None])[:, :, 0] + P[:, :, 3]
    return x[:, :2] / x[:, 2:]

"""Count keypoints that 2D3D-MatchNet could match on simulated streets.

Of each frame's cloud, the ISS keypoints (Zhong 2009) that the image shows, and those of them with a
SIFT keypoint within 3 px. For chance, the same with all SIFT keypoints moved by 40 px.

    python bench/street_keypoints.py --streets 10
"""

import argparse
from collections.abc import Iterator

import cv2
import numpy as np
from scipy.spatial import cKDTree

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.research.evaluation.street_frames import FIRST_FRAME, LAST_FRAME, MappedStreet
from semviz_core.simulation.lidar import VOXEL_M, depth_image, surfaces

SALIENT_M, APART_M = 6.0 * VOXEL_M, 4.0 * VOXEL_M
RATIO = 0.975
LEAST_NEIGHBOURS = 5
WITHIN_PX, MOVED_PX = 3.0, 40.0
LARGEST_SCALE = 2.5 * 1.6
HIDDEN = 0.05
"""Relative difference in depth to what the pixel shows."""


def iss(points_m: FloatArray) -> IntArray:
    """Return the rows of the ISS keypoints of a cloud (n, 3)."""
    tree = cKDTree(points_m)
    smallest = np.zeros(len(points_m))
    for row, near in enumerate(tree.query_ball_point(points_m, SALIENT_M)):
        if len(near) < LEAST_NEIGHBOURS:
            continue
        third, second, first = np.linalg.eigvalsh(np.cov(points_m[near].T))
        if second < RATIO * first and third < RATIO * second:
            smallest[row] = third
    largest = [smallest[near].max() for near in tree.query_ball_point(points_m, APART_M)]
    return np.flatnonzero((smallest > 0.0) & (smallest == np.array(largest)))


def counted(world: MappedStreet, index: int) -> Iterator[int]:
    """Yield numbers of a frame: ISS keypoints in the image, those it shows, SIFT keypoints, shown
    ones with SIFT beside them, and by chance."""
    view = world.street.view(index, "left")
    cloud = world.cloud(view.center_m)[:, :3]
    points = cloud[iss(cloud)]
    pixel, depth = view.project(points), view.depth(points)
    inside = (depth > 0.0) & view.camera.contains(pixel)
    rng = np.random.default_rng([world.street.seed, index])
    seen = depth_image(surfaces(world.street.layout, view.center_m), view, rng).inverse_depth
    u, v = np.round(pixel[inside]).astype(int).T
    shown = pixel[inside][np.abs(seen[v, u] * depth[inside] - 1.0) < HIDDEN]
    grey = cv2.cvtColor(world.street.image(index, "left"), cv2.COLOR_RGB2GRAY)
    found = cv2.SIFT_create().detect(grey, None)
    sift = np.array([point.pt for point in found if point.size / 2.0 <= LARGEST_SCALE])
    angle = rng.uniform(-np.pi, np.pi)
    moved = shown + MOVED_PX * np.array([np.cos(angle), np.sin(angle)])
    tree = cKDTree(sift)
    yield from (int(inside.sum()), len(shown), len(sift))
    for place in (shown, moved):
        yield int((tree.query(place)[0] < WITHIN_PX).sum()) if len(place) else 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=200, help="first street; tests begin at 250")
    options = parser.parse_args()
    rows = []
    for seed in range(options.seed, options.seed + options.streets):
        world = MappedStreet(seed)
        rows += [list(counted(world, index)) for index in range(FIRST_FRAME, LAST_FRAME, 11)]
    names = ("ISS in image", "shown", "SIFT", "SIFT within 3 px", "by chance")
    print(f"{len(rows)} frames")
    for name, values in zip(names, np.array(rows).T, strict=True):
        quartiles = " / ".join(f"{value:.0f}" for value in np.percentile(values, [25, 50, 75]))
        print(f"{name}: {quartiles}")


if __name__ == "__main__":
    main()

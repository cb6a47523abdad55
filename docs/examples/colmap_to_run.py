"""Turn a model of COLMAP, as hloc writes it, into a run: python colmap_to_run.py MODEL OUT.rrd.

MODEL is the folder of a text model (colmap model_converter --output_type TXT). The 3D points become
landmarks of one class, the 2D points observations, and each image of the first camera a frame.
Give the model a metric scale, or all metres of the run are in its units.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from semviz import (
    Camera,
    ClassSet,
    ElementClass,
    Elements2D,
    Elements3D,
    MapFrame,
    MatchedPose,
    Pose,
    RunRecorder,
    SemanticMap,
)

MOST_POINTS = 200  # with the longest tracks: the inspector draws each one
model, out = Path(sys.argv[1]), sys.argv[2]


def lines(name: str) -> list[list[str]]:
    text = (model / name).read_text().splitlines()
    return [line.split() for line in text if not line.startswith("#")]


# The camera. COLMAP counts pixels from the corner of the image, semviz from the first centre.
number, kind, width, height, fx, fy, cx, cy, *distortion = lines("cameras.txt")[0]
assert kind in ("PINHOLE", "OPENCV"), f"{kind}: undistort the images first"
K = np.array([[float(fx), 0, float(cx) - 0.5], [0, float(fy), float(cy) - 0.5], [0, 0, 1]])
camera = Camera(int(width), int(height), K)
lens = np.array([float(word) for word in distortion] or [0.0] * 4)

# The map: COLMAP's axes of the first camera (y down) turned to z up.
T_map_model = Pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
points = sorted(lines("points3D.txt"), key=len, reverse=True)[:MOST_POINTS]
ids = np.array([int(point[0]) for point in points])
position_m = T_map_model.apply(np.array([[float(x) for x in point[1:4]] for point in points]))
landmarks = Elements3D.from_ends(ids, position_m, np.full_like(position_m, np.nan), [0] * len(ids))
classes = ClassSet((ElementClass(0, "point", "point", "X", "diamond", "#56b4e9", "#0072b2"),))
semantic_map = SemanticMap(landmarks, MapFrame("colmap"), classes)

# The frames: two lines each, the pose and the 2D points (x, y, id of the 3D point).
rows = lines("images.txt")
images = [pair for pair in zip(rows[::2], rows[1::2], strict=True) if pair[0][8] == number]
with RunRecorder(out, semantic_map, camera, method="hloc") as recorder:
    for index, (head, tail) in enumerate(sorted(images, key=lambda pair: pair[0][9])):
        w, x, y, z, *t = (float(word) for word in head[1:8])
        T_camera_model = Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(t))
        seen = np.array(tail, dtype=float).reshape(-1, 3)
        seen = seen[np.isin(seen[:, 2], ids)]
        seen_px = cv2.undistortPoints(seen[:, None, :2] - 0.5, K, lens, P=K)[:, 0]
        observed = Elements2D.from_ends(seen_px, np.full((len(seen), 2), np.nan), [0] * len(seen))
        matches = np.column_stack([np.arange(len(seen)), seen[:, 2].astype(int)])
        estimate = T_camera_model @ T_map_model.inverse()
        recorder.add(index, MatchedPose(observed, estimate, matches))
print(f"{out}: {dict(recorder.statuses)}")

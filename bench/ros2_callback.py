"""The time of the body of a ROS 2 node's callback: a step of the tracker, without ROS.

    python bench/ros2_callback.py

Drives a simulated street with its simulated detector and prints the CPU time per frame.
"""

from time import process_time

import numpy as np

from semviz_core.base.frame import OdometryNoise, Prior
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street
from semviz_core.tracking.tracker import Tracker

FRAMES, SEED = 200, 7


def main() -> None:
    street = Street(SEED, StreetOptions(FRAMES))
    detector, noise = SimulatedDetector(street, "low", SEED), OdometryNoise()
    for _ in range(2):  # the first time compiles
        rng, tracker = np.random.default_rng(SEED), Tracker(street.rig.left, street.truth_map)
        before, times_ms, following = None, [], []
        for frame in street.frames:
            pose = frame.T_map_camera
            assert pose is not None
            odometry = None if before is None else noise.measure(pose.inverse() @ before, rng)
            before = pose
            observed = detector.detect(frame.index).observed
            prior = Prior(pose.translation + np.array([1.5, -1.0, 0.0]))
            start = process_time()
            found = tracker.step(observed, odometry, prior)
            times_ms.append(1e3 * (process_time() - start))
            following.append(found.status == "ok" and found.localization is None)
    at = np.array(following)
    for name, rows in (("following", at), ("starting or searching", ~at)):
        values = np.array(times_ms)[rows]
        median, p95 = np.percentile(values, [50, 95])
        print(f"{name}: {len(values)} frames, median {median:.1f} ms, p95 {p95:.1f} ms")


if __name__ == "__main__":
    main()

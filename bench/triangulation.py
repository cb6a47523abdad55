"""Accuracy of triangulated positions, and calibration of covariances, with some wrong labels.

    python bench/triangulation.py [--frames 1000]

The drive of ``bench/bundle_adjustment.py`` with exact poses and a frame every 4 m; a share of the
observations is shifted by 5 to 60 px in u and v. Position errors are of anchors; NEES (1 where a
covariance is honest) of all coordinates that were seen.
"""

import argparse
from dataclasses import replace

import numpy as np
from bundle_adjustment import SEED, drive

from semviz_annotation.mapping.placement.observations import ObservationArray
from semviz_annotation.mapping.placement.triangulation import (
    Landmarks,
    PlaceOptions,
    triangulate_landmarks,
    triangulate_linearly,
)
from semviz_core.common.arrays import FloatArray

OPTIONS = PlaceOptions(min_angle_rad=float(np.deg2rad(0.5)))
PLAIN = replace(OPTIONS, outlier_sigmas=np.inf)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1000)
    views, observations, truth = drive(
        parser.parse_args().frames, False, pose_sigmas=0.0, step_m=4.0
    )
    views_each = np.median(observations.seen)
    print(
        f"{len(observations)} observations of {observations.count} landmarks, "
        f"{views_each:.0f} each (median)"
    )
    print(f"{'wrong':>6} {'method':<22} {'placed':>7} {'median':>8} {'p95, m':>7} {'NEES':>8}")
    for wrong in (0.0, 0.05, 0.2):
        seen = with_outliers(observations, wrong)
        for name, placed in (
            ("rays and planes", triangulate_linearly(views, seen, OPTIONS)),
            ("least squares", triangulate_landmarks(views, seen, PLAIN)),
            ("robust, the default", triangulate_landmarks(views, seen, OPTIONS)),
        ):
            away = np.linalg.norm(placed.anchor_m - truth[:, :3], axis=1)[placed.ok]
            median, late = np.percentile(away, (50, 95))
            line = f"{wrong:>6.0%} {name:<22} {placed.ok.mean():>7.1%} {median:>8.3f} {late:>7.3f}"
            print(f"{line} {nees(placed, truth):>8.2f}")


def with_outliers(observations: ObservationArray, share: float) -> ObservationArray:
    rng = np.random.default_rng(SEED)
    k = len(observations)
    size = rng.uniform(5.0, 60.0, (k, 2)) * rng.choice([-1.0, 1.0], (k, 2))
    shift = np.where(rng.random((k, 1)) < share, size, 0.0)
    return replace(
        observations, anchor_px=observations.anchor_px + shift, end_px=observations.end_px + shift
    )


def nees(placed: Landmarks, truth: FloatArray) -> float:
    """Over its dimension; of signs, and of poles with both ends known."""
    is_line = np.isfinite(truth[:, 3])
    total, count = 0.0, 0
    for elements, size in ((placed.ok & ~is_line, 3), (placed.ok & is_line & placed.end_known, 6)):
        error = (placed.anchor_and_end_m - truth)[elements, :size]
        covariance = placed.covariance_m2[elements, :size, :size]
        total += float((error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum())
        count += error.size
    return total / count


if __name__ == "__main__":
    main()

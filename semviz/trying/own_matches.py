"""A frame solved from the matches that its run brought, by the solvers that take matches."""

from dataclasses import replace
from time import perf_counter

import numpy as np

from semviz.trying.asked import Asked
from semviz.trying.pair_changes import pairing_of
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.errors import SemvizError
from semviz_core.localization import Localization, Refinement
from semviz_core.solving.matched import Estimate, Failure, localize_matches
from semviz_core.solving.residuals import scene_residuals
from semviz_core.solving.scene import Scene


def from_own_matches(asked: Asked) -> Localization:
    """The answer to a question whose ``matched`` names a method."""
    assert asked.matched is not None
    pairs, score = own_matches(asked)
    start = perf_counter()
    found = localize_matches(
        asked.observed, asked.submap, asked.record.localization.camera, pairs, score,
        prior=asked.prior, method=asked.matched, seed=asked.localizer.seed,
        detector=asked.localizer.detector,
    )  # fmt: skip
    time_ms = {"matched": (perf_counter() - start) * 1e3}
    work = Localization(
        asked.matched, asked.record.localization.camera, asked.prior, asked.observed, asked.submap,
        status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=time_ms,
    )  # fmt: skip
    if isinstance(found, Failure):
        return replace(work, reason=found.reason)
    fine = _refinement(asked, found)
    if unmet := pairing_of(asked).unmet(fine, asked.submap):
        return replace(work, reason=unmet, refinement=fine)
    return replace(
        work,
        status="ok",
        reason=f"{int(found.inlier.sum())} of {len(pairs)} matches agree on one pose.",
        T_camera_map=found.T_camera_map,
        covariance=found.covariance,
        refinement=fine,
    )


def own_matches(asked: Asked) -> tuple[IntArray, FloatArray]:
    """(k, 2) rows (observed, submap) and their probabilities (k,), with forced pairs and without
    forbidden ones. SemvizError where the frame has no matches."""
    one = asked.record.localization
    if one.match is None:
        raise SemvizError("this frame was answered without matches; there is nothing to solve from")
    seen = {row: i for i, row in enumerate(asked.row.tolist())}
    mapped = {element: j for j, element in enumerate(asked.submap.id.tolist())}
    score: dict[tuple[int, int], float] = {}
    for row, column in one.match.order.tolist():
        i, j = seen.get(row), mapped.get(int(one.submap.id[column]))
        if i is not None and j is not None and _alike(asked, i, j):
            score[i, j] = float(one.match.probability[row, column])
    pairing = pairing_of(asked)
    for i, j in pairing.forced.tolist():
        score = {pair: p for pair, p in score.items() if pair[0] != i and pair[1] != j}
        score[i, j] = 1.0
    for i, j in pairing.forbidden.tolist():
        score.pop((i, j), None)
    return np.array(list(score), dtype=np.int64).reshape(-1, 2), np.array(list(score.values()))


def _alike(asked: Asked, i: int, j: int) -> bool:
    return bool(asked.observed.class_id[i] == asked.submap.class_id[j])


def _refinement(asked: Asked, found: Estimate) -> Refinement:
    """Its matches under its pose; which of them fit is for the method to say."""
    camera, detector = asked.record.localization.camera, asked.localizer.detector
    scene = Scene.of(camera, asked.observed, asked.submap, detector)
    pairs = found.pairs[found.inlier]
    off = scene_residuals(scene, found.T_camera_map, pairs)
    fits = np.ones(len(pairs), dtype=bool)
    return Refinement(pairs, off.residual_px, off.chi2, fits, np.array([off.chi2.sum()]))

"""Estimate a pose from scored matches, some of them wrong.

`matches` validates the matches, `minimal_solvers` solves samples of two or three of them, those of
three points by `p3p`, and `ransac` finds the pose with the largest one-to-one consensus.
`p3p_ransac` is the paper's own estimator, kept for comparison. A frame without consensus gets a
reason instead of a pose.
"""

from typing import Literal, get_args

from numpy.typing import ArrayLike

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.common.errors import SemvizError
from semviz_core.localization.matched.matches import Estimate, Matches, unsolvable_reason
from semviz_core.localization.matched.p3p_ransac import localize_p3p
from semviz_core.localization.matched.ransac import ransac_minimal
from semviz_core.localization.refinement import Failure

__all__ = ["METHODS", "Estimate", "Failure", "localize_matches"]

MatchedMethodName = Literal["minimal", "p3p"]
METHODS: tuple[MatchedMethodName, ...] = get_args(MatchedMethodName)


def localize_matches(
    observed: Elements2D,
    submap: Elements3D,
    camera: Camera,
    pairs: ArrayLike,
    score: ArrayLike,
    *,
    prior: Prior | None = None,
    method: MatchedMethodName = "minimal",
    seed: int = 0,
    detector: DetectorModel | None = None,
) -> Estimate | Failure:
    """Return the camera's pose from candidate matches, or the reason for none.

    ``pairs`` (k, 2) are rows of ``observed`` and of ``submap``, any number per element, most of
    which may be wrong; ``score`` (k,) in [0, 1] is the probability that each is right. ``minimal``
    is RANSAC over minimal samples of poles and signs. It uses the ``prior``, unless the matches
    contradict it, and the rate of hidden bottoms of ``detector``. ``p3p`` is the paper's P3P-RANSAC
    with direct PnPL, which uses neither. Repeatable with ``seed`` up to rounding: PoseLib's line
    solvers first turn their problem by a random rotation that no seed controls.

    Raise SemvizError if pairs or scores are impossible.
    """
    if method not in METHODS:
        raise SemvizError(f"unknown method {method!r}; known are {', '.join(METHODS)}")
    if seed < 0:
        raise SemvizError(f"seed {seed}: give 0 or more")
    matches = Matches.checked(observed, submap, camera, pairs, score, detector)
    if reason := unsolvable_reason(matches):
        return Failure(reason)
    return localize_p3p(matches, seed) if method == "p3p" else ransac_minimal(matches, prior, seed)

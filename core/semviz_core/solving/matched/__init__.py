"""Poses from matches with scores, some of them wrong."""

from typing import Literal, get_args

from numpy.typing import ArrayLike

from semviz_core.camera import Camera
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Prior
from semviz_core.solving.matched.matches import Estimate, Matches, why_unsolvable
from semviz_core.solving.matched.minimal import ransac_minimal
from semviz_core.solving.matched.p3p import localize_p3p
from semviz_core.solving.refine import Failure

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
    """The camera's pose from candidate matches, or the reason for none; never a made-up pose.

    ``pairs`` (k, 2) are rows of ``observed`` and of ``submap``, in any number per element, most of
    which may be wrong; ``score`` (k,) in [0, 1] says how likely each is right. ``minimal`` is
    RANSAC over minimal samples of poles and signs; it uses the ``prior`` where there is one, unless
    the matches contradict it, and what ``detector`` says of hidden bottoms. ``p3p`` is the paper's
    P3P-RANSAC with direct PnPL, which uses neither. Repeatable with ``seed``, but for rounding:
    PoseLib's line solvers first turn their problem by a random rotation that no seed reaches.

    Raises SemvizError for pairs and scores that cannot be.
    """
    if method not in METHODS:
        raise SemvizError(f"unknown method {method!r}; known are {', '.join(METHODS)}")
    if seed < 0:
        raise SemvizError(f"seed {seed}: give 0 or more")
    matches = Matches.checked(observed, submap, camera, pairs, score, detector)
    if reason := why_unsolvable(matches):
        return Failure(reason)
    return localize_p3p(matches, seed) if method == "p3p" else ransac_minimal(matches, prior, seed)

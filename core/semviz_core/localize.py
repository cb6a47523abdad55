"""The whole method on one screen: what is seen and mapped, to a pose or the reason for none."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Prior
from semviz_core.learning.models import MODELS
from semviz_core.localization import Alternative, Localization, Search
from semviz_core.matching.posterior import posterior_match
from semviz_core.pose import Pose
from semviz_core.request import check_request
from semviz_core.solving.direct import pairs_by_class
from semviz_core.solving.effort import USUAL, WIDE
from semviz_core.solving.pairing import Pairing
from semviz_core.solving.refine import FIXING_PAIRS, NEEDED_PAIRS, Failure, Refined, refine
from semviz_core.solving.scene import Scene
from semviz_core.solving.search import Modes, mode_near, search
from semviz_core.solving.upright import assumed_upright
from semviz_core.solving.verdict import Verdict, is_likely, judge
from semviz_core.stopwatch import Stopwatch
from semviz_core.threads import in_order

if TYPE_CHECKING:
    from semviz_core.learning.chain import Chain
    from semviz_core.learning.verifier import ModeVerifier

EFFORTS = {"search": USUAL, "direct": USUAL, "wide": WIDE, "learned": WIDE}
"""Of the methods that search."""
METHODS = (*EFFORTS, *MODELS)
TRAINED = {"learned": "verifier", **{name: name for name in MODELS}}
"""What the methods that have learned something have weights of."""
NEEDED_ELEMENTS = 4
"""As in the paper. Three can fix an upright pose, but no fourth is left to tell one of a row of
poles from the next."""
SHOWN_NATS = 30.0
"""Poses that are worse than the best by more are no alternatives."""

FREE = Pairing()
"""Nothing is supposed."""

Request: TypeAlias = tuple[Elements2D, Elements3D, Camera, Prior]
"""The arguments of ``Localizer.localize``."""


def methods_at_hand() -> tuple[str, ...]:
    """METHODS without those whose weights did not come with semviz."""
    from semviz_core.learning.weights import shipped_weights

    return tuple(
        one for one in METHODS if one not in TRAINED or shipped_weights(TRAINED[one]).is_file()
    )


@dataclass(frozen=True)
class Localizer:
    """Localizes single frames. ``method`` is one of METHODS; repeatable with ``seed``.

    ``weights`` is a file of what a learned method has learned, if not what comes with semviz.
    """

    method: str = "search"
    seed: int = 0
    classes: ClassSet = DEFAULT_CLASSES
    detector: DetectorModel = field(default_factory=DetectorModel)
    weights: Path | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SemvizError(f"unknown method {self.method!r}; known are {', '.join(METHODS)}")
        if not isinstance(self.seed, int) or self.seed < 0:
            raise SemvizError(f"seed {self.seed}: give a whole number, 0 or more")
        if not isinstance(self.classes, ClassSet):
            raise SemvizError("classes is no ClassSet; give semviz.DEFAULT_CLASSES or your own")
        self.detector.checked()
        if not isinstance(self.weights, Path | None):
            raise SemvizError(f"weights is of type {type(self.weights).__name__}; give a Path")
        if self.method in MODELS:
            self._chain()
        elif self.method == "learned":
            self._verifier()
        elif self.weights is not None:
            raise SemvizError(f"method {self.method} has learned nothing; leave weights out")

    def localize(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        *,
        pairing: Pairing = FREE,
        start: Pose | None = None,
    ) -> Localization:
        """The camera's pose in the map, or the reason for none; never a made-up pose.

        ``pairing`` says what is supposed of who is who; ``start`` (T_camera_map) takes the place of
        the search: the answer is the optimum near it. Raises SemvizError where these cannot be
        meant (``semviz_core.request``).
        """
        check_request(observed, submap, camera, prior, self.classes)
        pairing.check(observed, submap)
        watch = Stopwatch()
        work = Localization(
            self.method, camera, prior, observed, submap,
            status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=watch.time_ms,
        )  # fmt: skip
        if reason := _too_few(observed, submap):
            return replace(work, reason=reason)
        scene = pairing.applied(Scene.of(camera, observed, submap, self.detector))
        if self.method in MODELS:
            return self._chain().localize(work, scene, pairing, start, watch)
        pairs = pairs_by_class(observed, scene) if self.method == "direct" else None
        if isinstance(pairs, Failure):
            return replace(work, reason=pairs.reason)

        prior = assumed_upright(prior)  # the result keeps the prior as given
        modes, probability = self._modes(work, scene, prior, start, watch)
        poses = tuple(_pose(modes, row) for row in range(len(modes.score)))
        found = Search(modes.tried, poses, modes.score, modes.passed, modes.match)
        work = replace(work, search=found)
        if not len(modes.score):
            return replace(work, reason=_nothing_fits(prior))
        work = replace(work, match=watch.time("match", lambda: posterior_match(
            modes.score, modes.gain, scene.compatible)))  # fmt: skip

        if pairs is None:
            pairs = modes.pairs(0)
        needed = FIXING_PAIRS if is_likely(probability) else NEEDED_PAIRS
        refined = watch.time("refine", lambda: refine(scene, prior, poses[0], pairs, needed))
        if isinstance(refined, Failure):
            return replace(work, reason=refined.reason)
        verdict = judge(modes, refined, observed, submap, prior, probability)
        if unmet := pairing.unmet(refined.refinement, submap):
            verdict = Verdict("cannot", unmet)
        return _answered(work, found, refined, verdict)

    def _modes(
        self, work: Localization, scene: Scene, prior: Prior, start: Pose | None, watch: Stopwatch
    ) -> tuple[Modes, FloatArray | None]:
        """The likeliest first; and how likely each is, where that is learned."""
        if start is not None:
            return watch.time("search", lambda: mode_near(scene, prior, start)), None
        modes = watch.time("search", lambda: search(scene, prior, EFFORTS[self.method]))
        if self.method != "learned":
            return modes, None
        given = work.observed, work.submap, work.camera, prior
        return watch.time("verify", lambda: self._verifier().verified(*given, modes))

    def _verifier(self) -> "ModeVerifier":
        """SemvizError where there are no weights, or they are for something else."""
        from semviz_core.learning.verifier import load_verifier

        return load_verifier(self.weights, self.classes)

    def _chain(self) -> "Chain":
        """SemvizError where there are no weights, or they are for something else."""
        from semviz_core.learning.chain import Chain
        from semviz_core.learning.inference import load_matcher

        return Chain(load_matcher(self.method, self.weights, self.classes), self.seed)

    def localize_many(
        self, requests: Iterable[Request], threads: int = 1
    ) -> Iterator[Localization]:
        """Many frames: each (observed, submap, camera, prior) localized, in order.

        The compiled search lets other threads run meanwhile. Raises SemvizError as ``localize``
        does, with the request's number (from 0).
        """
        if threads < 1:
            raise SemvizError(f"threads is {threads}; give 1 or more")
        return in_order(self._numbered, enumerate(requests), threads)

    def _numbered(self, numbered: tuple[int, Request]) -> Localization:
        number, request = numbered
        try:
            return self.localize(*request)
        except SemvizError as error:
            raise SemvizError(f"request {number}: {error}") from error


def _too_few(observed: Elements2D, submap: Elements3D) -> str:
    seen = len(observed)
    if seen < NEEDED_ELEMENTS:
        return f"{seen} element{'' if seen == 1 else 's'} seen, {NEEDED_ELEMENTS} needed."
    if len(submap) == 0:
        return "Nothing is mapped around the prior: the submap is empty."
    return ""


def _nothing_fits(prior: Prior) -> str:
    heading = "" if prior.heading_rad is None else ", its heading"
    return (
        f"No two elements fit one pose within the prior's fix ({prior.horizontal_sigma_m:.1f} m)"
        f"{heading} and height: one of these is wrong, or the map."
    )


def _answered(
    work: Localization, found: Search, refined: Refined, verdict: Verdict
) -> Localization:
    answered = verdict.status != "cannot"
    return replace(
        work,
        status=verdict.status,
        reason=verdict.reason,
        T_camera_map=refined.T_camera_map if answered else None,
        covariance=refined.covariance if answered else None,
        refinement=refined.refinement,
        alternatives=_alternatives(found),
    )


def _alternatives(found: Search) -> tuple[Alternative, ...]:
    poses, score = found.T_camera_map, found.score
    near = np.flatnonzero(score >= score[0] - SHOWN_NATS)[1:]
    return tuple(Alternative(poses[row], float(score[row])) for row in near)


def _pose(modes: Modes, row: int) -> Pose:
    return Pose(modes.rotation[row], modes.translation[row])

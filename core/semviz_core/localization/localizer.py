"""Localize single frames: from elements to a pose with its status, or a reason for none.

`Localizer.localize` checks the input and selects the method. `Localizer._estimate` is the method:
search, association, refinement, status. The same input and seed give the same result. Methods
that this package does not own are found through entry points.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, ElementClass
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Alternative, Localization, Match, Search
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import Stopwatch, count_compiled, in_order
from semviz_core.localization import refinement
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.correspondences.matcher import (
    CoupleHypotheses,
    PairMatcher,
    load_pair_matcher,
)
from semviz_core.localization.crowding import pairs_by_chance
from semviz_core.localization.heading_votes import DEFAULT_EFFORT, OF_COUPLES, WIDE, Effort
from semviz_core.localization.match_probabilities import posterior_match
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.request import check_request, example_request
from semviz_core.localization.search import (
    Modes,
    Propose,
    mode_near,
    most_voted,
    search,
    with_sigma_scale,
)
from semviz_core.localization.status import (
    StatusDecision,
    decide_status,
    is_likely,
)
from semviz_core.localization.upright import assumed_upright

if TYPE_CHECKING:
    from semviz_core.localization.mode_verifier import ModeVerifier


def match_by_class(observed: Elements2D, problem: PoseProblem) -> IntArray | refinement.Failure:
    """Return the pairs (k, 2) that classes alone determine (the paper's simple scene, eq. 8).

    Fail if several observed or several mapped elements of a class are compatible. Observed
    elements without a compatible mapped one are left out.
    """
    pairs = []
    for i, compatible in enumerate(problem.compatible):
        mapped = np.flatnonzero(compatible)
        seen = np.flatnonzero(problem.compatible[:, mapped].any(axis=1))
        if len(seen) > 1 or len(mapped) > 1:
            return refinement.Failure(
                f"Classes do not fix the matches: {len(seen)} seen and {len(mapped)} mapped "
                f"of class {observed.class_id[i]}; at most one each is needed. Use method search."
            )
        if len(mapped):
            pairs.append((i, int(mapped[0])))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


EFFORTS = {
    "search": DEFAULT_EFFORT,
    "direct": DEFAULT_EFFORT,
    "learned": WIDE,
    "correspondences": OF_COUPLES,
}
"""The search effort of each method of this package."""
NETWORKS = {"learned": "verifier", "correspondences": "matcher"}
"""The network of each learned method of this package."""
ENTRY_POINTS = "semviz.methods"
"""The entry point group of all other methods: each entry names a ``LoadMethod``."""
NEEDED_ELEMENTS = 4
"""As in the paper. Three elements can fix an upright pose, but only a fourth can distinguish one
pole of a row from the next."""
MAX_ALTERNATIVE_NATS = 30.0
"""Poses further below the best are no alternatives."""

NO_CONSTRAINTS = PairConstraints()
"""Every pair is free."""

Request: TypeAlias = tuple[Elements2D, Elements3D, Camera, Prior]
"""The arguments of ``Localizer.localize``."""


class LearnedMethod(Protocol):
    """A method that replaces the whole pipeline of ``Localizer``."""

    def localize(
        self,
        work: Localization,
        problem: PoseProblem,
        pairing: PairConstraints,
        start: Pose | None,
        watch: Stopwatch,
    ) -> Localization:
        """Return ``work`` completed: search, match, refinement, pose and status.

        ``problem`` has the constraints of ``pairing`` applied. ``start`` (T_camera_map) replaces
        the search.
        """


class LoadMethod(Protocol):
    def __call__(
        self, name: str, weights: Path | None, classes: ClassSet, seed: int
    ) -> LearnedMethod:
        """Return the method ``name``, with weights from a file, by default the shipped ones.

        Raise SemvizError if the weights are missing or of another network.
        """


@cache
def _entry_points() -> dict[str, EntryPoint]:
    """Return the entry points of methods by name, without those of EFFORTS."""
    entries = entry_points(group=ENTRY_POINTS)
    return {entry.name: entry for entry in entries if entry.name not in EFFORTS}


def known_methods() -> tuple[str, ...]:
    """Return the names of all methods of ``Localizer``."""
    return (*EFFORTS, *_entry_points())


def available_methods() -> tuple[str, ...]:
    """Return ``known_methods`` without those whose weights are not shipped."""
    from semviz_core.base.weights import shipped_weights

    untrained = set(EFFORTS) - set(NETWORKS)
    return tuple(
        method
        for method in known_methods()
        if method in untrained or shipped_weights(NETWORKS.get(method, method)).is_file()
    )


@dataclass(frozen=True)
class Localizer:
    """Localize single frames with ``method``, one of ``known_methods``; repeatable with ``seed``.

    ``weights`` is the weight file of a learned method (default: the shipped weights). ``effort``
    replaces the search effort of the method.
    """

    method: str = "search"
    seed: int = 0
    classes: ClassSet = DEFAULT_CLASSES
    detector: DetectorModel = field(default_factory=DetectorModel)
    weights: Path | None = None
    effort: Effort | None = None

    def __post_init__(self) -> None:
        if self.method not in EFFORTS and self.method not in _entry_points():
            known = ", ".join(known_methods())
            raise SemvizError(f"unknown method {self.method!r}; known are {known}")
        if not isinstance(self.seed, int) or self.seed < 0:
            raise SemvizError(f"seed {self.seed}: give a whole number, 0 or more")
        if not isinstance(self.classes, ClassSet):
            raise SemvizError("classes is not a ClassSet; give semviz.DEFAULT_CLASSES or your own")
        self.detector.checked()
        if not isinstance(self.weights, Path | None):
            raise SemvizError(f"weights is of type {type(self.weights).__name__}; give a Path")
        if self.method not in EFFORTS:
            self._external_method()
        elif self.method == "learned":
            self._verifier()
        elif self.method == "correspondences":
            self._matcher()
        elif self.weights is not None:
            raise SemvizError(f"method {self.method} uses no weights; leave weights out")

    def localize(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        *,
        pairing: PairConstraints = NO_CONSTRAINTS,
        start: Pose | None = None,
    ) -> Localization:
        """Return the camera's pose in the map with its status, or the reason for none.

        ``pairing`` forces or forbids correspondences. ``start`` (T_camera_map) replaces the search:
        the result is the optimum near it. Raise SemvizError if the input is inconsistent
        (``semviz_core.localization.request``).
        """
        check_request(observed, submap, camera, prior, self.classes)
        pairing.check(observed, submap)
        watch = Stopwatch()
        work = Localization(
            self.method, camera, prior, observed, submap,
            status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=watch.time_ms,
        )  # fmt: skip
        if reason := too_few(observed, submap):
            return replace(work, reason=reason)
        problem = pairing.applied(PoseProblem.of(camera, observed, submap, self.detector))
        if self.method not in EFFORTS:
            return self._external_method().localize(work, problem, pairing, start, watch)
        return self._estimate(work, problem, pairing, start, watch)

    def warmup(self, tell: Callable[[int], None] = lambda compiled: None) -> None:
        """Compile the method, or load it from disk, so that no frame's time contains that.

        The first time on a machine this takes a minute; ``tell`` hears after each function how many
        are compiled. Other processes wait for it, and load what it compiled.
        """
        # classes alone do not fix the example's matches; `direct` shares its code with `search`
        localizer = replace(self, method="search") if self.method == "direct" else self
        request = example_request(self.classes)
        with count_compiled(tell):
            found = localizer.localize(*request)
            localizer.localize(*request, start=found.T_camera_map)

    def _estimate(
        self,
        work: Localization,
        problem: PoseProblem,
        pairing: PairConstraints,
        start: Pose | None,
        watch: Stopwatch,
    ) -> Localization:
        """Complete ``work``: search, association, refinement, status."""
        observed, submap = work.observed, work.submap
        pairs = match_by_class(observed, problem) if self.method == "direct" else None
        if isinstance(pairs, refinement.Failure):
            return replace(work, reason=pairs.reason)

        # 1 search: the modes, poses that explain the image, best first
        prior = assumed_upright(work.given_prior)  # the result keeps the prior as given
        propose: Propose = most_voted
        if self.method == "correspondences":  # P comes first, and proposes the poses
            match = self._correspondences(work, problem, pairing, watch)
            work, propose = replace(work, match=match), CoupleHypotheses(match)
        modes, probability = self._modes(work, problem, prior, start, propose, watch)
        found = _search_result(modes)
        work = replace(work, search=found)
        problem = with_sigma_scale(problem, modes.sigma_scale)
        if not found.T_camera_map:
            return replace(work, reason=nothing_fits(prior))

        # 2 association: P over all modes, with dustbins (the paper's eq. 3-4 has none)
        if work.match is None:
            work = replace(work, match=watch.time("match", lambda: posterior_match(
                modes.score, modes.gain, problem.compatible)))  # fmt: skip

        # 3 refinement of the best mode: eq. 8, P being Boolean, whitened and with the prior
        if pairs is None:
            pairs = modes.pairs(0)
        needed = refinement.FIXING_PAIRS if is_likely(probability) else refinement.NEEDED_PAIRS
        best = found.T_camera_map[0]
        estimate = watch.time(
            "refine", lambda: refinement.refine_pose(problem, prior, best, pairs, needed)
        )
        if isinstance(estimate, refinement.Failure):
            return replace(work, reason=estimate.reason)

        # 4 status: ok, ambiguous or cannot
        by_chance = pairs_by_chance(problem, estimate.T_camera_map)
        decision = decide_status(modes, estimate, observed, submap, prior, probability, by_chance)
        if violated := pairing.violated(estimate.refinement, submap):
            decision = StatusDecision("cannot", violated)
        return _completed(work, found, estimate, decision)

    def _modes(
        self,
        work: Localization,
        problem: PoseProblem,
        prior: Prior,
        start: Pose | None,
        propose: Propose,
        watch: Stopwatch,
    ) -> tuple[Modes, FloatArray | None]:
        """Return the modes, best first, and the verifier's probability (b,) of each, if any."""
        effort = self.effort or EFFORTS[self.method]
        if start is not None:
            return watch.time("search", lambda: mode_near(problem, prior, start)), None
        modes = watch.time("search", lambda: search(problem, prior, effort, propose))
        if not self._verifies:
            return modes, None
        frame = work.observed, work.submap, work.camera, prior
        return watch.time("verify", lambda: self._verifier().verified(*frame, modes))

    def _correspondences(
        self, work: Localization, problem: PoseProblem, pairing: PairConstraints, watch: Stopwatch
    ) -> Match:
        """Return the learned correspondences, among the pairs that ``pairing`` leaves."""
        frame = work.observed, work.submap, work.camera, work.given_prior
        constraints = problem.compatible, pairing.forced
        return watch.time("match", lambda: self._matcher().match(*frame, *constraints))

    def _matcher(self) -> PairMatcher:
        """Load the matcher.

        Raise SemvizError if the weights are missing or of another network.
        """
        return load_pair_matcher(self.weights, self.classes)

    @property
    def _verifies(self) -> bool:
        """Whether the verifier chooses among the modes: the shipped one knows only its classes."""
        knows = all(class_ in self.classes.classes for class_ in DEFAULT_CLASSES)
        of_pairs = self.method == "correspondences" and knows
        return of_pairs or self.method == "learned"

    @property
    def untrained_classes(self) -> tuple[ElementClass, ...]:
        """Classes that the method's network was not trained for: it takes their elements for those
        of a class that it knows (``as_known``), and the search and the refinement do not."""
        if self.method not in NETWORKS:
            return ()
        network = self._matcher() if self.method == "correspondences" else self._verifier()
        return tuple(class_ for class_ in self.classes if class_.id not in network.classes)

    def _verifier(self) -> "ModeVerifier":
        """Load the verifier; for ``correspondences``, whose own weights are the matcher's, the
        shipped one.

        Raise SemvizError if the weights are missing or of another network.
        """
        from semviz_core.localization.mode_verifier import load_verifier

        weights = self.weights if NETWORKS[self.method] == "verifier" else None
        return load_verifier(weights, self.classes)

    def _external_method(self) -> LearnedMethod:
        """Load the method from its entry point.

        Raise SemvizError if the weights are missing or of another network.
        """
        load: LoadMethod = _entry_points()[self.method].load()
        return load(self.method, self.weights, self.classes, self.seed)

    def localize_many(
        self, requests: Iterable[Request], threads: int = 1
    ) -> Iterator[Localization]:
        """Yield the result of each request (observed, submap, camera, prior), in order.

        The compiled search releases the GIL. Raise SemvizError as ``localize`` does, with the
        request's number (from 0).
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


def too_few(observed: Elements2D, submap: Elements3D) -> str:
    seen = len(observed)
    if seen < NEEDED_ELEMENTS:
        return f"{seen} element{'' if seen == 1 else 's'} seen, {NEEDED_ELEMENTS} needed."
    if len(submap) == 0:
        return "Nothing is mapped around the prior: the submap is empty."
    return ""


def nothing_fits(prior: Prior) -> str:
    heading = "" if prior.heading_rad is None else ", its heading"
    return (
        f"No two elements fit one pose within the prior's fix ({prior.horizontal_sigma_m:.1f} m)"
        f"{heading} and height: one of these is wrong, or the map."
    )


def _search_result(modes: Modes) -> Search:
    rows = range(len(modes.score))
    poses = tuple(Pose(modes.rotation[row], modes.translation[row]) for row in rows)
    return Search(modes.evaluated, poses, modes.score, modes.passed, modes.match)


def _completed(
    work: Localization,
    found: Search,
    estimate: refinement.PoseEstimate,
    decision: StatusDecision,
) -> Localization:
    has_pose = decision.status != "cannot"
    return replace(
        work,
        status=decision.status,
        reason=decision.reason,
        T_camera_map=estimate.T_camera_map if has_pose else None,
        covariance=estimate.covariance if has_pose else None,
        refinement=estimate.refinement,
        alternatives=alternatives_of(found),
    )


def alternatives_of(found: Search) -> tuple[Alternative, ...]:
    poses, score = found.T_camera_map, found.score
    near = np.flatnonzero(score >= score[0] - MAX_ALTERNATIVE_NATS)[1:]
    return tuple(Alternative(poses[row], float(score[row])) for row in near)

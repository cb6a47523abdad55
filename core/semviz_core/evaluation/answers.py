"""Methods under test: given a problem, each answers with a pose or the reason for none.

A module with methods offers them by name: ``METHODS: dict[str, Callable[[], Method]]`` for single
frames, ``MATCHED_METHODS`` for frames whose matches are given. Calling an entry makes the method;
it raises ImportError where a library that it needs is not installed, and SemvizError
where it has no weights.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Protocol

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.evaluation.bound import bound_covariance
from semviz_core.evaluation.matched_problems import MatchedProblem
from semviz_core.evaluation.problems import DETECTOR, Problem
from semviz_core.learning.models import MODELS
from semviz_core.localization import Localization, Status
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.solving.least_squares import fit_pairs
from semviz_core.solving.scene import Scene


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method says about one frame."""

    T_camera_map: Pose | None
    """None exactly when status is ``cannot``."""
    covariance: FloatArray | None
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians. None where there is
    no pose or the method does not know."""
    status: Status
    reason: str
    """One sentence in plain words."""
    time_ms: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage, in order."""

    def __post_init__(self) -> None:
        if (self.T_camera_map is None) != (self.status == "cannot"):
            raise ValueError("an answer has a pose exactly when its status is not 'cannot'")

    @classmethod
    def of(cls, localization: Localization) -> "Answer":
        return cls(
            localization.T_camera_map,
            localization.covariance,
            localization.status,
            localization.reason,
            localization.time_ms,
        )


class Method(Protocol):
    """Localizes single frames from what is observed, mapped and known beforehand."""

    @property
    def name(self) -> str: ...

    def answer(self, problem: Problem) -> Answer:
        """Never looks at ``problem.T_camera_map``, ``pairs`` or ``end_visible``: the answers."""
        ...


class MatchedMethod(Protocol):
    """Localizes frames whose matches are given, some of them wrong."""

    @property
    def name(self) -> str: ...

    @property
    def with_prior(self) -> bool:
        """Whether it makes use of the prior: the bound that it is measured against does too."""
        ...

    def answer(self, problem: MatchedProblem) -> Answer:
        """Never looks at the truth in ``problem.problem``, nor at ``problem.true``."""
        ...


@dataclass(frozen=True)
class LocalizerMethod:
    """``Localizer`` with the rates of the problems' detector; ``name`` is that of its method.

    Raises SemvizError where a learned method has no weights.
    """

    name: str
    seed: int = 0
    localizer: Localizer = field(init=False)

    def __post_init__(self) -> None:
        localizer = Localizer(self.name, self.seed, detector=DETECTOR)
        object.__setattr__(self, "localizer", localizer)

    def answer(self, problem: Problem) -> Answer:
        given = problem.observed, problem.submap, problem.camera, problem.prior
        return Answer.of(self.localizer.localize(*given))


@dataclass(frozen=True)
class TrueMatches:
    """Maximum likelihood from the truth with the true pairs: what perfect matching would give.

    A reference, not a method: it knows the answers, and which bottoms are hidden.
    """

    name: str = "true matches"
    with_prior: bool = True

    def answer(self, problem: Problem) -> Answer:
        start = perf_counter()
        known = problem.observed.end_known & problem.end_visible
        observed = replace(problem.observed, end_known=known)
        scene = Scene.of(problem.camera, observed, problem.submap)
        prior = problem.prior if self.with_prior else None
        fit = fit_pairs(scene, prior, problem.T_camera_map, problem.pairs)
        time_ms = {"fit": (perf_counter() - start) * 1e3}
        if np.linalg.eigvalsh(fit.information)[0] < 1e-9:
            return Answer(None, None, "cannot", "The pairs do not fix a pose.", time_ms)
        covariance = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
        reason = f"{len(problem.pairs)} true pairs fitted."
        return Answer(fit.T_camera_map, covariance, "ok", reason, time_ms)


@dataclass(frozen=True)
class Bound:
    """The truth with an error drawn from the frame's Cramer-Rao bound: an efficient estimator.

    A reference, not a method: it knows the answers. A frame's error is the same in every run.
    """

    name: str = "bound"
    with_prior: bool = True

    def answer(self, problem: Problem) -> Answer:
        covariance = bound_covariance(problem, with_prior=self.with_prior)
        if covariance is None:
            return Answer(None, None, "cannot", "Nothing bounds the pose.")
        seed = np.frombuffer(problem.T_camera_map.translation.tobytes(), dtype=np.uint32)
        error = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance)
        pose = Pose.exp(error) @ problem.T_camera_map
        return Answer(pose, covariance, "ok", "Drawn from the bound.")


@dataclass(frozen=True)
class OnFrame:
    """A reference that answers frames with given matches as it answers the frames alone."""

    reference: TrueMatches | Bound

    @property
    def name(self) -> str:
        return self.reference.name

    @property
    def with_prior(self) -> bool:
        return self.reference.with_prior

    def answer(self, problem: MatchedProblem) -> Answer:
        return self.reference.answer(problem.problem)


METHODS: dict[str, Callable[[], Method]] = {
    "search": lambda: LocalizerMethod("search"),
    "direct": lambda: LocalizerMethod("direct"),
    "wide": lambda: LocalizerMethod("wide"),
    "learned": lambda: LocalizerMethod("learned"),
    **{name: partial(LocalizerMethod, name) for name in MODELS},
    "true matches": TrueMatches,
    "bound": Bound,
}
MATCHED_METHODS: dict[str, Callable[[], MatchedMethod]] = {
    "true matches": lambda: OnFrame(TrueMatches()),
    "true matches alone": lambda: OnFrame(TrueMatches("true matches alone", False)),
    "bound": lambda: OnFrame(Bound()),
    "bound alone": lambda: OnFrame(Bound("bound alone", False)),
}
"""``alone``: without the prior."""
BOUNDS = ("bound", "bound alone")
"""Those that mean nothing where the noise is not what is stated."""

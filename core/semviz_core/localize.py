"""The whole method on one screen: what is seen and mapped, to a pose or the reason for none."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TypeVar

import numpy as np

from semviz_core.camera import Camera
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Prior
from semviz_core.localization import Alternative, Localization, Search
from semviz_core.matching.posterior import posterior_match
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.direct import pairs_by_class
from semviz_core.solving.refine import Failure, refine
from semviz_core.solving.residuals import Scene
from semviz_core.solving.search import Modes, search
from semviz_core.solving.upright import assumed_upright
from semviz_core.solving.verdict import judge

METHODS = ("search", "direct")
NEEDED_ELEMENTS = 4
"""As in the paper. Three can fix an upright pose, but no fourth is left to tell one of a row of
poles from the next."""
SHOWN_NATS = 30.0
"""Poses that are worse than the best by more are no alternatives."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Localizer:
    """Localizes single frames. ``method`` is ``search`` or ``direct``; repeatable with ``seed``."""

    method: str = "search"
    seed: int = 0
    classes: ClassSet = DEFAULT_CLASSES

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SemvizError(f"unknown method {self.method!r}; known are {', '.join(METHODS)}")
        if self.seed < 0:
            raise SemvizError(f"seed {self.seed}: give 0 or more")

    def localize(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> Localization:
        """The camera's pose in the map, or the reason for none; never a made-up pose.

        Raises SemvizError for elements of unknown classes or with impossible covariances.
        """
        self._check_classes(observed)
        _check_covariances(submap)
        watch = _Stopwatch({})
        work = Localization(
            self.method, camera, prior, observed, submap,
            status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=watch.time_ms,
        )  # fmt: skip
        if reason := _too_few(observed, submap):
            return replace(work, reason=reason)
        pairs = pairs_by_class(observed, submap) if self.method == "direct" else None
        if isinstance(pairs, Failure):
            return replace(work, reason=pairs.reason)

        scene = Scene.of(camera, observed, submap)
        prior = assumed_upright(prior)  # the result keeps the prior as given
        rng = np.random.default_rng(self.seed)
        modes = watch.time("search", lambda: search(scene, camera, prior, rng))
        work = replace(work, search=_search_value(modes))
        if not len(modes.score):
            return replace(work, reason=_nothing_passed(modes, prior))
        work = replace(work, match=watch.time("match", lambda: posterior_match(
            modes.score, modes.gain, scene.compatible)))  # fmt: skip

        refined = watch.time("refine", lambda: refine(scene, camera, prior, _pose(modes, 0), pairs))
        if isinstance(refined, Failure):
            return replace(work, reason=refined.reason)
        verdict = judge(modes, refined, observed, submap)
        answered = verdict.status != "cannot"
        return replace(
            work,
            status=verdict.status,
            reason=verdict.reason,
            T_camera_map=refined.T_camera_map if answered else None,
            covariance=refined.covariance if answered else None,
            refinement=refined.refinement,
            alternatives=_alternatives(modes),
        )

    def _check_classes(self, observed: Elements2D) -> None:
        unknown = [one for one in np.unique(observed.class_id).tolist() if one not in self.classes]
        if unknown:
            known = ", ".join(str(one.id) for one in self.classes)
            raise SemvizError(f"observed elements have unknown classes {unknown}; known: {known}")


def _check_covariances(submap: Elements3D) -> None:
    eigenvalues = np.linalg.eigvalsh(submap.covariance_m2)  # (n, 6), ascending
    broken = eigenvalues[:, 0] < -1e-6 * (1.0 + eigenvalues[:, -1])  # rounding is far below
    if broken.any():
        first = int(submap.id[broken][0])
        raise SemvizError(f"map element {first}: its covariance is not one; rebuild the map")


def _too_few(observed: Elements2D, submap: Elements3D) -> str:
    seen = len(observed)
    if seen < NEEDED_ELEMENTS:
        return f"{seen} elements seen, {NEEDED_ELEMENTS} needed."
    if len(submap) == 0:
        return "Nothing is mapped around the prior: the submap is empty."
    return ""


def _nothing_passed(modes: Modes, prior: Prior) -> str:
    return (
        f"None of {modes.tried} hypotheses lies within the prior's "
        f"{prior.horizontal_sigma_m:.1f} m, height and heading."
    )


def _search_value(modes: Modes) -> Search:
    poses = tuple(_pose(modes, row) for row in range(len(modes.score)))
    return Search(modes.tried, poses, modes.score)


def _alternatives(modes: Modes) -> tuple[Alternative, ...]:
    near = np.flatnonzero(modes.score >= modes.score[0] - SHOWN_NATS)[1:]
    return tuple(Alternative(_pose(modes, row), float(modes.score[row])) for row in near)


def _pose(modes: Modes, row: int) -> Pose:
    return Pose(nearest_rotation(modes.rotation[row]), modes.translation[row])


@dataclass(frozen=True)
class _Stopwatch:
    time_ms: dict[str, float]

    def time(self, stage: str, action: Callable[[], Result]) -> Result:
        start = perf_counter()
        result = action()
        self.time_ms[stage] = (perf_counter() - start) * 1e3
        return result

"""What is handed in together: each mistake is refused in words, and nothing else is."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, TRIANGULAR
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.localization.request import check_request
from semviz_core.research.evaluation.problems import LocalizationProblem, make_problem

PROBLEM = next(
    problem
    for problem in map(make_problem, count(1))
    if len(problem.observed) >= 12 and not problem.observed.is_line.all()
)


def check(problem: LocalizationProblem) -> None:
    check_request(problem.observed, problem.submap, problem.camera, problem.prior, DEFAULT_CLASSES)


@pytest.mark.parametrize("seed", range(20))
def test_what_a_detector_sees_passes(seed: int) -> None:
    check(make_problem(seed))


def test_nothing_seen_and_nothing_mapped_pass() -> None:
    check(replace(PROBLEM, observed=PROBLEM.observed[[]], submap=PROBLEM.submap[[]]))


def reversed_2d(seen: Elements2D) -> Elements2D:
    """Poles upside down; signs as they are."""
    line = seen.is_line[:, None]
    return replace(
        seen,
        anchor_px=np.where(line, seen.end_px, seen.anchor_px),
        end_px=np.where(line, seen.anchor_px, np.nan),
        anchor_known=np.ones(len(seen), dtype=bool),
        end_known=seen.is_line,
    )


def reversed_3d(mapped: Elements3D) -> Elements3D:
    line = mapped.is_line[:, None]
    return replace(
        mapped,
        anchor_m=np.where(line, mapped.end_m, mapped.anchor_m),
        end_m=np.where(line, mapped.anchor_m, np.nan),
    )


def with_class(elements: Any, class_id: int) -> Any:
    return replace(elements, class_id=np.full(len(elements), class_id))


QUARTER = Pose.from_rotvec([np.pi / 2, 0.0, 0.0], np.zeros(3))
MISTAKES: dict[str, tuple[Callable[[LocalizationProblem], dict[str, Any]], str]] = {
    "array for elements": (
        lambda p: {"observed": p.observed.anchor_px},
        "observed is of type ndarray; give Elements2D",
    ),
    "map for submap": (
        lambda p: {"submap": SemanticMap(p.submap, MapFrame("whole"))},
        "submap is of type SemanticMap; give Elements3D",
    ),
    "matrix for camera": (
        lambda p: {"camera": p.camera.K},
        "camera is of type ndarray",
    ),
    "no prior": (lambda p: {"prior": None}, "prior is of type NoneType; give Prior"),
    "unknown class seen": (
        lambda p: {"observed": with_class(p.observed, 9)},
        r"observed elements have unknown class 9; known: 0 \(pole\)",
    ),
    "unknown class mapped": (
        lambda p: {"submap": with_class(p.submap, -1)},
        "map elements have unknown class -1",
    ),
    "poles without ends": (
        lambda p: {"observed": with_class(p.observed[~p.observed.is_line], POLE)},
        "observed element in row 0, a pole, has no end",
    ),
    "signs with ends": (
        lambda p: {"submap": with_class(p.submap[p.submap.is_line], TRIANGULAR)},
        "map element in row 0, a triangular sign, has an end",
    ),
    "rows and columns swapped": (
        lambda p: {"camera": Camera(p.camera.height, p.camera.width, p.camera.K)},
        "observed elements lie outside the 376x1241 image",
    ),
    "seen upside down": (
        lambda p: {"observed": reversed_2d(p.observed)},
        "most observed poles",
    ),
    "gravity for up": (
        lambda p: {"prior": replace(p.prior, up_camera=-np.asarray(p.prior.up_camera))},
        "turn prior.up_camera round",
    ),
    "mapped upside down": (
        lambda p: {"submap": reversed_3d(p.submap)},
        "most mapped poles",
    ),
    "map with y up": (
        lambda p: {"submap": p.submap.transformed(QUARTER)},
        "so that z is up",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_refused(name: str) -> None:
    change, message = MISTAKES[name]
    problem = replace(PROBLEM, **change(PROBLEM))
    with pytest.raises(SemvizError, match=message):
        check(problem)


def moved_right(seen: Elements2D, by_px: float) -> Elements2D:
    step = np.array([by_px, 0.0])
    return replace(seen, anchor_px=seen.anchor_px + step, end_px=seen.end_px + step)


def test_few_elements_and_those_a_little_outside_pass() -> None:
    """Noise puts them there, and one of one is most."""
    seen, width = PROBLEM.observed, PROBLEM.camera.width
    check(replace(PROBLEM, observed=moved_right(seen[:1], 2.0 * width)))
    check(replace(PROBLEM, observed=moved_right(seen[:3], 2.0 * width)))
    all_out = width - seen.anchor_px[:, 0].min()
    at_edge = replace(seen, anchor_px=seen.anchor_px * [0.0, 1.0], end_px=seen.end_px * [0.0, 1.0])
    check(replace(PROBLEM, observed=moved_right(at_edge, 1.19 * width)))
    with pytest.raises(SemvizError, match="lie outside the 1241x376 image"):
        check(replace(PROBLEM, observed=moved_right(seen, all_out + 0.21 * width)))

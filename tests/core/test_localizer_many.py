"""Many frames: threads give what a loop gives, in its order, and say which request was wrong."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

import numpy as np
import pytest

from semviz_core.common.errors import SemvizError
from semviz_core.localization.localizer import Localizer, Request
from semviz_core.research.evaluation.problems import make_problem

PROBLEMS = [make_problem(seed) for seed in range(700, 712)]
REQUESTS: list[Request] = [
    (result.observed, result.submap, result.camera, result.prior) for result in PROBLEMS
]


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_give_the_same_as_a_loop(threads: int) -> None:
    localizer = Localizer()
    many = list(localizer.localize_many(iter(REQUESTS), threads))
    assert len(many) == len(REQUESTS)
    for request, found in zip(REQUESTS, many, strict=True):
        alone = localizer.localize(*request)
        assert found.observed is request[0]
        assert (found.status, found.reason) == (alone.status, alone.reason)
        assert (found.T_camera_map is None) == (alone.T_camera_map is None)
        if found.T_camera_map is not None and alone.T_camera_map is not None:
            np.testing.assert_array_equal(
                found.T_camera_map.translation, alone.T_camera_map.translation
            )
            np.testing.assert_array_equal(found.covariance, alone.covariance)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_wrong_request_is_named_after_those_before_it(threads: int) -> None:
    observed, submap, camera, prior = REQUESTS[2]
    unknown = replace(observed, class_id=np.full(len(observed), 9))
    results = Localizer().localize_many(
        [*REQUESTS[:2], (unknown, submap, camera, prior), *REQUESTS[3:]], threads
    )
    assert len(list(islice(results, 2))) == 2
    with pytest.raises(SemvizError, match="request 2: observed elements have unknown class 9"):
        next(results)


@pytest.mark.parametrize("threads", [1, 2])
def test_requests_are_taken_as_they_are_needed(threads: int) -> None:
    taken: list[int] = []

    def endless() -> Iterator[Request]:
        for number in count():
            taken.append(number)
            yield REQUESTS[number % len(REQUESTS)]

    assert len(list(islice(Localizer().localize_many(endless(), threads), 3))) == 3
    assert len(taken) <= 3 + 2 * threads


def test_no_threads_are_refused_at_once() -> None:
    with pytest.raises(SemvizError, match="threads is 0; give 1 or more"):
        Localizer().localize_many(REQUESTS, threads=0)

"""What passes tell of a map: existence by the counts, and planted changes of a street."""

import itertools
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from changing_street import ChangingStreet, drive, place_m
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.passes.candidates import candidates
from semviz_annotation.mapping.passes.changed_map import changed_map
from semviz_annotation.mapping.passes.changes import Change, MapChanges, find_changes
from semviz_annotation.mapping.passes.evidence import Pass, evidence_of
from semviz_annotation.mapping.passes.existence import PassCounts, change_between, existence_of
from semviz_annotation.mapping.quality.diff import diff_maps
from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import SIMULATED_DETECTOR
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.frame import Frame
from semviz_core.base.localization import Localization
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.simulation.street import Street

CHANGE, PASSES = 3, 8
RATE = 0.7


def counts(*elements: list[tuple[int, int]]) -> PassCounts:
    """Of (frames that saw it, frames in which it was in view), for each pass."""
    values = np.array(elements)
    return PassCounts(values[..., 1], RATE * values[..., 1], values[..., 0])


def exists(*passes: tuple[int, int], mapped: bool = True) -> float:
    """Among twenty elements that every pass sees."""
    standing = [[SEEN] * len(passes)] * 20
    found = existence_of(counts(list(passes), *standing), np.array([mapped] + [True] * 20))
    return float(found.now[0])


SEEN, MISSED, NO_CHANCE = (7, 10), (0, 10), (0, 0)


def test_an_element_that_is_missed_again_and_again_is_gone() -> None:
    assert exists(*[SEEN] * 3) > 0.99
    series = [exists(*[SEEN] * 3, *[MISSED] * n) for n in range(6)]
    assert all(later < earlier for earlier, later in itertools.pairwise(series))
    assert series[1] > 0.5
    assert series[5] < 0.05


def test_passes_without_a_chance_say_nothing() -> None:
    with_gaps = [SEEN, NO_CHANCE, SEEN, MISSED, NO_CHANCE, MISSED, MISSED]
    assert exists(*with_gaps) == pytest.approx(exists(SEEN, SEEN, MISSED, MISSED, MISSED), abs=0.05)
    assert exists(*[SEEN] * 3, *[NO_CHANCE] * 5) > 0.9


def test_what_is_often_hidden_is_not_gone_when_it_is_hidden_again() -> None:
    often_hidden = [SEEN, MISSED, SEEN, MISSED, MISSED, SEEN, MISSED, MISSED]
    always_seen = [SEEN] * 6 + [MISSED] * 2
    assert exists(*often_hidden) > exists(*always_seen)


def test_more_missed_frames_of_one_pass_are_not_more_passes() -> None:
    """What hides an element hides it in all frames of a pass."""
    assert exists(*[SEEN] * 3, (0, 1000)) > exists(*[SEEN] * 3, *[MISSED] * 3)


def test_an_element_is_new_once_several_passes_see_it() -> None:
    appeared = [MISSED, MISSED, SEEN, SEEN, SEEN]
    found = existence_of(counts(appeared), np.array([False]))
    assert found.now[0] > 0.95
    assert found.first[0] == 2
    assert exists(MISSED, MISSED, (2, 10), MISSED, MISSED, mapped=False) < 0.5


def test_time_between_passes_counts_where_it_is_known() -> None:
    """Missed an hour after it was seen, an element is rather hidden than gone."""
    day_s, missed = 86400.0, [SEEN, SEEN, SEEN, MISSED, MISSED]
    rows = counts(missed, *[[SEEN] * 5] * 20)

    def now(*days: float | None) -> float:
        times = [None if day is None else day * day_s for day in days]
        return float(existence_of(rows, np.full(21, True), change_between(times)).now[0])

    month = now(0.0, 30.0, 60.0, 90.0, 120.0)
    assert now(0.0, 0.1, 0.2, 0.3, 0.4) > month + 0.1
    assert now(0.0, 30.0, 60.0, 1000.0, 1000.1) < month - 0.02
    assert now(0.0, 30.0, None, 90.0, 120.0) == pytest.approx(month, abs=0.01)


def test_a_place_that_changes_much_makes_each_change_likelier() -> None:
    standing, gone = [SEEN] * 6, [SEEN] * 3 + [MISSED] * 3

    def now(vanished: int) -> float:
        rows = counts(*[standing] * (30 - vanished), *[gone] * vanished)
        return float(existence_of(rows, np.full(30, True)).now[-1])

    assert now(5) < now(1)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=6))
def test_existence_is_that_of_all_possible_lives(passes: list[tuple[int, int]]) -> None:
    """Against a sum over lives, one after the other, for one probability to be hidden at a time."""
    from semviz_annotation.mapping.passes import existence

    rows = [(min(pair), max(pair)) for pair in passes]
    expected_rate = patch.multiple(existence, _FACTORS=(1.0,), _FACTOR_PRIOR=(1.0,))
    with expected_rate:
        found = existence_of(counts(rows), np.array([True]))
    p, change = len(rows), existence.CHANGE_PER_PASS

    def rated(seen: int, chances: int, rate: float) -> float:
        return float(rate**seen * (1.0 - rate) ** (chances - seen))

    def absent(seen: int, chances: int) -> float:
        return 0.97 * rated(seen, chances, 0.01) + 0.03 * rated(seen, chances, 0.3)

    def present(seen: int, chances: int, hidden: float) -> float:
        rate = RATE if chances else 0.02
        visible = 0.85 * rated(seen, chances, rate) + 0.15 * rated(seen, chances, 0.4 * rate)
        return hidden * absent(seen, chances) + (1.0 - hidden) * visible

    by_hidden = []
    for hidden in existence.HIDDEN:
        lives = []
        for gone in range(p + 1):
            prior = 0.02 if gone == 0 else 0.98 * (1.0 - change) ** (gone - 1)
            prior *= change if 0 < gone < p else 1.0
            there = [present(*row, float(hidden)) for row in rows[:gone]]
            lives.append(prior * np.prod([*there, *(absent(*row) for row in rows[gone:])]))
        by_hidden.append(lives)
    lives = np.array(by_hidden)  # (g, p + 1)
    weights = start = existence.HIDDEN_PRIOR / existence.HIDDEN_PRIOR.sum()
    for _ in range(5):
        posterior = weights * lives.sum(axis=1)
        weights = posterior / posterior.sum() + 20.0 * start
        weights = weights / weights.sum()
    of_life = weights @ lives
    assert found.now[0] == pytest.approx(of_life[p] / of_life.sum(), rel=1e-6)


@pytest.fixture(scope="module")
def world() -> ChangingStreet:
    """Three elements that most frames show change before the pass ``CHANGE``."""
    street = Street(5)
    still = ChangingStreet(street, {}, {}, {}, {})
    shown = [id_ for id_ in street.truth_map.elements.id.tolist() if still.is_shown(id_)]
    poles = [
        id_
        for id_ in shown
        if street.truth_map.elements.is_line[id_ == street.truth_map.elements.id][0]
    ]
    signs = [id_ for id_ in shown if id_ not in poles]
    return ChangingStreet(
        street,
        {poles[0]: CHANGE},
        {signs[0]: CHANGE},
        {poles[3]: CHANGE},
        {poles[3]: np.array([0.9, -1.2, 0.0])},
    )


@pytest.fixture(scope="module")
def passes(world: ChangingStreet) -> list[Pass]:
    return [drive(world, number, hidden_share=0.05) for number in range(PASSES)]


@pytest.fixture(scope="module")
def found(world: ChangingStreet, passes: list[Pass]) -> MapChanges:
    first = world.first_map
    return find_changes(passes, first, Labels(triangle_center=first.triangle_center))


def test_a_detection_that_two_elements_explain_tells_of_neither(
    world: ChangingStreet, passes: list[Pass]
) -> None:
    first = world.first_map
    standing = next(id_ for id_ in first.elements.id.tolist() if id_ not in world.moves
                    and id_ not in world.vanishes and world.is_shown(id_))  # fmt: skip
    row = int(np.flatnonzero(first.elements.id == standing)[0])
    twin = replace(first.elements[[row]], id=first.elements.id.max() + np.array([1]))
    both = replace(first, elements=joined(first.elements, twin), provenance=(), attributes={})
    alone, shared = evidence_of(passes[:2], first), evidence_of(passes[:2], both, candidates=1)
    assert alone.counts.seen[row].sum() >= 8
    assert shared.counts.seen[[row, -1]].sum() == 0
    others = np.arange(len(first)) != row
    assert (shared.counts.seen[:-1][others] == alone.counts.seen[others]).all()


def of_kind(found: MapChanges, kind: str) -> list[Change]:
    return [change for change in found.changes if change.kind == kind]


def test_planted_changes_are_found_and_nothing_else(
    world: ChangingStreet, found: MapChanges
) -> None:
    (vanished,), (new,), (moved,) = (of_kind(found, kind) for kind in ("vanished", "new", "moved"))
    assert vanished.name == world.first_map.name_of(*world.vanishes)
    assert vanished.since == str(CHANGE)
    assert new.since == str(CHANGE)
    truth = world.street.truth_map
    assert np.linalg.norm(place_m(truth, *world.appears) - new.place_m[:2]) < 0.5
    assert moved.name == world.first_map.name_of(*world.moves)
    assert moved.moved_m == pytest.approx(1.5, abs=0.4)
    assert np.linalg.norm(place_m(truth, *world.moves) - moved.place_m[:2]) < 0.4


def test_what_two_frames_of_each_pass_show_is_a_candidate(
    world: ChangingStreet, passes: list[Pass]
) -> None:
    """One pass alone is not enough: two false detections may agree."""
    first, (new,) = world.first_map, world.appears
    elements = world.street.truth_map.elements
    at_m = elements.anchor_m[elements.id == new][0]
    few = [showing_twice(one, at_m) for one in passes[CHANGE + 1 :]]

    def near(some: list[Pass]) -> int:
        labels = Labels(triangle_center=first.triangle_center)
        found = candidates(some, first, labels, lambda what, done, of: None)
        away_m = np.linalg.norm(found.anchor_m - at_m, axis=1)
        return int((away_m < 1.5).sum())

    assert near(few) == 1
    assert near(few[:1]) == 0


def showing_twice(one: Pass, at_m: FloatArray) -> Pass:
    """The pass without the sure frames that detect something at a point (3,), but for two."""
    show = [position for position in one.sure if detects(one.localizations[position], at_m)]
    blind = set(show) - {show[len(show) // 2], show[-1]}
    results = tuple(
        replace(result, status="ambiguous") if position in blind else result
        for position, result in enumerate(one.localizations)
    )
    return replace(one, localizations=results)


def detects(result: Localization, at_m: FloatArray) -> bool:
    assert result.T_camera_map is not None
    point = result.T_camera_map.apply(at_m[None])
    off_px = result.observed.anchor_px - result.camera.project(point)
    return bool(point[0, 2] > 0.0 and (np.abs(off_px).max(axis=1) < 12.0).any())


@pytest.mark.parametrize("seed", range(6))
def test_passes_together_place_what_each_sees_from_one_direction(seed: int) -> None:
    """Three frames of a pass see a far pole within a degree or two, so its distance is open by
    metres. A pass may have another camera."""
    passes = [approaching(np.random.default_rng([seed, number]), number) for number in range(5)]
    found = candidates(passes, EMPTY_MAP, Labels(), lambda what, done, of: None)
    away_m = np.linalg.norm(found.anchor_m[:, :2] - FAR_POLE_M[0, :2], axis=1)
    assert len(found) == 1
    assert away_m[0] < 1.2


EMPTY_MAP = SemanticMap(Elements3D.from_ends([], [], [], []), MapFrame("street"))
FAR_POLE_M = np.array([[6.0, 40.0, 3.4], [6.0, 40.0, 0.1]])
AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def approaching(rng: np.random.Generator, number: int) -> Pass:
    """Three frames that see the pole from 38 to 28 m, with noise of detections and poses."""
    f = 720.0 + 300.0 * (number % 2)
    camera = Camera(1240, 376, np.array([[f, 0.0, 620.0], [0.0, f, 180.0], [0.0, 0.0, 1.0]]))
    frames: list[Frame] = []
    results: list[Localization] = []
    for index, y in enumerate(np.sort(rng.choice(np.arange(2.0, 13.0), 3, replace=False))):
        T = Pose(AHEAD, -AHEAD @ np.array([0.0, y, 1.65]))
        px = camera.project(T.apply(FAR_POLE_M)) + rng.standard_normal((2, 2))
        noise = Pose.from_rotvec(rng.normal(0.0, 5e-4, 3), rng.normal(0.0, 0.02, 3))
        seen = Elements2D.from_ends(px[:1], px[1:], [0])
        covariance = np.diag([0.02**2] * 3 + [5e-4**2] * 3)
        frames.append(Frame(index, float(index)))
        results.append(
            Localization("test", camera, None, seen, EMPTY_MAP.elements, "ok", "It fits.",
                         noise @ T, covariance)
        )  # fmt: skip
    return Pass(f"{number}", tuple(frames), tuple(results), SIMULATED_DETECTOR)


def test_a_street_that_does_not_change_is_found_unchanged(world: ChangingStreet) -> None:
    still = ChangingStreet(world.street, {}, {}, {}, {})
    passes = [drive(still, number, hidden_share=0.05) for number in range(4)]
    found = find_changes(passes, still.first_map, Labels(triangle_center="centroid"))
    assert [change for change in found.changes if change.kind != "unsure"] == []


def test_the_changed_map_is_that_of_the_changed_street(
    world: ChangingStreet, found: MapChanges, tmp_path: Path
) -> None:
    changed = changed_map(found, found.sure)
    save_map(changed, tmp_path / "next.parquet")
    diff = diff_maps(world.first_map, load_map(tmp_path / "next.parquet"))
    assert len(changed) == len(world.first_map)
    assert world.vanishes.keys().isdisjoint(changed.elements.id.tolist())
    (moved,) = world.moves
    assert np.linalg.norm(place_m(changed, moved) - place_m(world.street.truth_map, moved)) < 0.4
    told = diff.as_text()
    assert world.first_map.name_of(*world.vanishes) in told
    assert world.first_map.name_of(moved) in told


def test_a_kept_element_stays_as_it_is(world: ChangingStreet, found: MapChanges) -> None:
    (vanished,) = world.vanishes
    kept = changed_map(found, found.sure - {world.first_map.name_of(vanished)})
    assert vanished in kept.elements.id.tolist()
    with pytest.raises(SemvizError, match="P-9999 is no change of this map"):
        changed_map(found, ["P-9999"])


def test_attributes_go_with_what_vanished_and_stay_with_all_others(
    world: ChangingStreet, found: MapChanges
) -> None:
    (vanished,), (moved,) = world.vanishes, world.moves
    ids = world.first_map.elements.id.tolist()
    standing = next(id_ for id_ in ids if id_ not in (vanished, moved))
    told = {id_: {"lamp": "yes"} for id_ in (vanished, moved, standing)}
    annotated = replace(found, semantic_map=replace(found.semantic_map, attributes=told))
    changed = changed_map(annotated, found.sure)
    assert changed.attributes == {id_: told[id_] for id_ in (moved, standing)}
    assert changed_map(annotated, ()).attributes == told


def test_one_pass_is_not_enough(world: ChangingStreet, passes: list[Pass]) -> None:
    nothing = replace(passes[1], frames=(), localizations=())
    with pytest.raises(SemvizError, match="one pass cannot tell a miss from a change"):
        find_changes([passes[0], nothing], world.first_map, Labels(triangle_center="centroid"))

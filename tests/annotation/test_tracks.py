"""Which labels are one landmark: merges, splits, outliers, and what people decided."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.street_labels import (
    DrivenTwice,
    StreetLabels,
    careful,
    label_street,
    with_mistakes,
)

from semviz_annotation.labels.edits import DecideElements
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, new_id
from semviz_annotation.labels.rows import Rules, different_elements, review_decision
from semviz_annotation.mapping.association.candidates import LandmarkPositions, agreement
from semviz_annotation.mapping.association.nodes import CannotLink, Reason
from semviz_annotation.mapping.build import PART_ID, BuildOptions, build_map
from semviz_annotation.mapping.placement.observations import collect_observations
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.semantic_map import Decision, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

SIGN, OTHER = np.array([22.0, -4.0, 2.4]), np.array([25.0, -3.0, 2.4])
POLE = (np.array([20.0, 5.0, 4.0]), np.array([20.0, 5.02, 0.4]))
NEAR_IS_ONE = BuildOptions(pose_sigma_m=1.0)
"""So lax that only the hard rule keeps neighbours apart."""


def renamed(labels: Labels, name: Callable[[int, Observation], int]) -> Labels:
    """With the label elements that ``name`` gives each observation, from its present number."""
    elements: dict[int, LabelElement] = {}
    rows = []
    for row in labels.observations.values():
        old = labels.element(row.element_id)
        number = name(old.number, row)
        element = elements.setdefault(number, LabelElement(new_id(), number, old.class_id))
        rows.append(replace(row, element_id=element.id))
    return Labels.from_rows([*elements.values(), *rows])


def id_of(labels: Labels, number: int) -> str:
    return next(element.id for element in labels.elements.values() if element.number == number)


def decided(semantic_map: SemanticMap, kind: str) -> list[Decision]:
    return [decision for decision in semantic_map.decisions if decision.kind == kind]


def halves(number: int, row: Observation) -> int:
    """A landmark is labelled anew from frame 3 on."""
    return number + 10 * (row.frame_index >= 3)


def test_a_planted_duplicate_is_merged(world):
    labels = renamed(world.labels(sigma_px=0.5), lambda n, row: halves(n, row) if n == 4 else n)
    built, _ = build_map(labels, world)
    assert list(built.elements.id) == [3, 4, 7, 9]
    (merge,) = built.decisions
    assert (merge.kind, merge.numbers, merge.by) == ("merge", (4, 14), "machine")
    assert merge.label_ids == (id_of(labels, 4), id_of(labels, 14)) == built.provenance[1].label_ids
    assert merge.evidence["frames"] == world.count
    assert merge.evidence["chi2_apart"] < merge.evidence["chi2_together"]
    assert merge.evidence["chi2_together"] < 2.0 * merge.evidence["freedom"]
    assert 0.0 < merge.evidence["distance_m"] < 3.0
    whole = build_map(world.labels(sigma_px=0.5), world)[0].elements
    assert np.allclose(built.elements.anchor_m, whole.anchor_m, atol=1e-4)


def test_neighbours_seen_together_stay_two_transitively(make_world):
    """One is labelled anew in frame 2, the other in frame 3: only frame 2 shows new and old."""
    twins = make_world({1: (1, SIGN, None), 2: (1, SIGN + np.array([0.0, 0.8, 0.0]), None)})
    labels = renamed(
        twins.labels(sigma_px=0.5),
        lambda n, row: n + 10 * (row.frame_index >= 1 + n),
    )
    built, _ = build_map(labels, twins, NEAR_IS_ONE)
    assert [decision.numbers for decision in decided(built, "merge")] == [(1, 11), (2, 12)]
    assert np.allclose(built.elements.anchor_m[0], SIGN, atol=0.3)
    (two,) = decided(built, "apart")
    assert two.by == "machine"
    assert two.reason.endswith("shows both in its left image")
    assert 0.5 < two.evidence["distance_m"] < 1.1
    single = renamed(labels, lambda n, row: n)
    alone = [row for row in single.observations.values() if row.frame_index in (0, 4)]
    alone = [r for r in alone if single.element(r.element_id).number in (1, 12)]
    rows = [single.element(element_id) for element_id in {row.element_id for row in alone}]
    assert len(build_map(Labels.from_rows([*rows, *alone]), twins, NEAR_IS_ONE)[0]) == 1


@given(st.integers(0, 2**32 - 1))
def test_no_group_has_a_mark_twice(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    node = rng.integers(0, n, 20)
    pairs = np.unique(np.stack([node, rng.integers(0, 15, 20)]), axis=1)
    exclusion = CannotLink(pairs[0], pairs[1], (Reason("image"),) * 15)
    group = rng.integers(-1, 3, n)
    out = exclusion.clashing(group, rng.permutation(n))
    kept = np.where(out, -1, group)
    named = [
        (kept[pair], mark) for pair, mark in zip(pairs[0], pairs[1], strict=True) if kept[pair] >= 0
    ]
    assert len(set(named)) == len(named)
    member, other = rng.integers(0, n, (2, 8))
    marks = [set(pairs[1][pairs[0] == row].tolist()) for row in range(n)]
    expected = [min(marks[a] & marks[b], default=-1) for a, b in zip(member, other, strict=True)]
    assert exclusion.shared(member, other).tolist() == expected


def under_one_name(make_world, sigma_px: float = 0.3):
    """Two signs, 3 m apart; the second is called as the first from frame 4 on."""
    signs = {5: (1, SIGN, None), 6: (1, OTHER, None), 7: (0, *POLE)}
    world = make_world(signs, count=6)
    labels = world.labels(sigma_px=sigma_px)
    kept = [
        row
        for row in labels.observations.values()
        if (number := labels.element(row.element_id).number) == 7
        or (row.frame_index < 4) == (number == 5)
    ]
    some = Labels.from_rows([*labels.elements.values(), *kept])
    return world, renamed(some, lambda n, row: 5 if n == 6 else n)


def test_a_planted_split_is_found(make_world):
    world, labels = under_one_name(make_world)
    built, report = build_map(labels, world)
    assert list(built.elements.id) == [5, 7, PART_ID + 5]
    assert np.allclose(built.elements.anchor_m[0], SIGN, atol=0.3)
    assert np.allclose(built.elements.anchor_m[2], OTHER, atol=0.3)
    (split,) = built.decisions
    assert (split.kind, split.numbers, split.label_ids) == ("split", (5,), (id_of(labels, 5),))
    frames = {labels.observation(id_).frame_index for id_ in split.observation_ids}
    assert frames == {4, 5}
    assert set(split.observation_ids) == set(built.provenance[2].observation_ids)
    assert split.evidence["distance_m"] == pytest.approx(np.hypot(3.0, 1.0), abs=0.3)
    assert "split T-05: 4 of its labels are of another landmark 3." in str(report)
    _, ids = observe(labels, 5, "left", built)
    assert sorted(ids) == [7, PART_ID + 5]


def test_what_is_split_off_joins_what_it_is(make_world):
    """The second sign has a name of its own, too, in the frames before."""
    world, labels = under_one_name(make_world)
    again = replace(world, landmarks={8: (1, OTHER, None)}).labels()
    before = [row for row in again.observations.values() if row.frame_index < 4]
    rows = [*labels.rows(), *again.elements.values(), *before]
    both = Labels.from_rows(rows)
    built, report = build_map(both, world)
    assert list(built.elements.id) == [5, 7, 8]
    (split,) = built.decisions
    assert (split.kind, split.numbers) == ("split", (5,))
    assert split.reason.endswith("which is number 8")
    assert "split T-05" in str(report)
    assert set(split.observation_ids) < set(built.provenance[2].observation_ids)
    assert built.provenance[2].label_ids == (id_of(both, 8),)


def test_people_have_the_last_word(make_world):
    world, labels = under_one_name(make_world)

    def built_after(*verdicts) -> SemanticMap:
        judged_ = labels.changed(DecideElements(verdicts).changes(labels, Rules()))
        return build_map(judged_, world)[0]

    kept = built_after(review_decision(id_of(labels, 5), "keep"))
    assert list(kept.elements.id) == [5, 7]
    assert kept.decisions == ()
    assert len(kept.provenance[0].observation_ids) == 12
    gone = built_after(review_decision(id_of(labels, 5), "leave out"))
    assert list(gone.elements.id) == [7]
    (left_out,) = gone.decisions
    assert (left_out.kind, left_out.numbers, left_out.by) == ("leave out", (5,), "human")


def test_what_a_person_called_two_is_two(world):
    labels = renamed(world.labels(), lambda n, row: n + 10 * (row.frame_index % 3) if n == 4 else n)
    first = different_elements(id_of(labels, 4), id_of(labels, 14))
    judged_labels = labels.changed(DecideElements((first,)).changes(labels, Rules()))
    built, report = build_map(judged_labels, world)
    assert len(built) == 5
    (second,) = decided(built, "apart")
    assert (second.numbers, second.by) == ((4, 14), "human")
    assert "a person said that 4 and 14 are two landmarks" in str(report)
    (merge,) = decided(built, "merge")
    assert merge.numbers in ((4, 24), (14, 24))


def test_the_order_of_rows_means_nothing():
    given = detected(1)
    rows = list(given.labels.rows())
    order = np.random.default_rng(0).permutation(len(rows))
    shuffled = Labels.from_rows([rows[k] for k in order])
    built, _ = build_map(given.labels, STREET, MACHINE)
    other, _ = build_map(shuffled, STREET, MACHINE)
    assert built.digest == other.digest
    assert built.decisions == other.decisions
    assert built.provenance == other.provenance


def test_ids_stay_when_labels_are_added(world):
    labels = renamed(world.labels(sigma_px=0.3), lambda n, row: n + 10 * row.frame_index)
    first = [row for row in labels.observations.values() if row.frame_index < 3]
    elements = {row.element_id: labels.element(row.element_id) for row in first}
    before, _ = build_map(Labels.from_rows([*elements.values(), *first]), world)
    after, _ = build_map(labels, world)
    assert np.array_equal(before.elements.id, after.elements.id)


# -- streets


STREET = Street(3, StreetOptions(frames=24))
MACHINE = BuildOptions(sigma_px=1.3, min_frames=2)


def detected(seed: int) -> StreetLabels:
    return label_street(SimulatedDetector(STREET, "low", seed).detect, range(24))


def landmarks_of(built: SemanticMap, given: StreetLabels) -> list[Counter[int]]:
    """What each map element is made from."""
    return [
        Counter(given.truth[name].element_id for name in entry.observation_ids)
        for entry in built.provenance
    ]


def test_a_street_without_identity_gives_each_landmark_once():
    given = label_street(careful(STREET, 0.5, 1), range(24))
    built, _ = build_map(given.labels, STREET, BuildOptions(sigma_px=0.5))
    landmarks = landmarks_of(built, given)
    assert all(len(landmark) == 1 for landmark in landmarks)
    assert len({next(iter(landmark)) for landmark in landmarks}) == len(built) > 15


def test_no_element_is_seen_twice_in_one_image():
    given = detected(2)
    built, _ = build_map(given.labels, STREET, BuildOptions(sigma_px=4.0, pose_sigma_m=1.0))
    assert decided(built, "merge")
    for entry in built.provenance:
        rows = [given.labels.observation(name) for name in entry.observation_ids]
        assert len({(row.frame_index, row.side) for row in rows}) == len(rows)


def test_mistakes_in_identity_are_found():
    given = label_street(careful(STREET, 0.5, 1), range(24), memory=8)
    mixed, names = with_mistakes(given, 4, seed=5)
    built, _ = build_map(mixed.labels, STREET, BuildOptions(sigma_px=0.5))
    landmarks = landmarks_of(built, given)
    assert all(len(landmark) == 1 for landmark in landmarks)
    found = {
        decision.label_ids[0]
        for decision in built.decisions
        if decision.kind in ("split", "leave out")
    }
    assert found == names


def test_a_second_pass_with_other_poses_is_the_same_street():
    source = DrivenTwice(STREET, 0.3, seed=1)
    see = source.seen_by(careful(STREET, 0.5, 1), careful(STREET, 0.5, 2))
    given = label_street(see, range(48), memory=24)
    built, _ = build_map(given.labels, source, BuildOptions(sigma_px=0.5, pose_sigma_m=0.2))
    strict, _ = build_map(given.labels, source, BuildOptions(sigma_px=0.5, pose_sigma_m=0.001))
    landmarks = [votes.most_common(1)[0][0] for votes in landmarks_of(built, given)]
    assert len(landmarks) == len(set(landmarks)) < 0.7 * len(strict)
    seen = Counter(row.element_id for row in given.truth.values())
    assert {landmark for landmark, count in seen.items() if count > 8} <= set(landmarks)


@pytest.mark.parametrize("number", [3, 7])
def test_the_test_of_one_place_keeps_its_level(world, number):
    """chi2 of pairs from frame 1 at the place that all other frames give, 40 times."""
    ratios = []
    for seed in range(40):
        labels = world.labels(sigma_px=1.0, seed=seed)
        views, observations, elements, _ = collect_observations(labels, world)
        row = [element.number for element in elements].index(number)
        mine = observations.only(np.arange(observations.count) == row)
        first = views.frame_index[mine.view] == 1
        others = triangulate_landmarks(
            views, mine.where(~first), PlaceOptions(outlier_sigmas=np.inf)
        )
        result = agreement(views, mine.where(first), LandmarkPositions.of(others), 1.0, 0.0)
        ratios.append(result.chi2[0] / result.freedom[0])
    assert 0.75 < np.mean(ratios) < 1.25


def test_nothing_is_left_where_people_leave_out_all(world):
    labels = world.labels()
    every = tuple(review_decision(element, "leave out") for element in sorted(labels.elements))
    with pytest.raises(SemvizError, match="nothing can be placed; the first of all: a person said"):
        build_map(labels.changed(DecideElements(every).changes(labels, Rules())), world)
    some = every[:3]
    built, _ = build_map(labels.changed(DecideElements(some).changes(labels, Rules())), world)
    assert len(built) == 1
    assert [decision.by for decision in built.decisions] == ["human"] * 3


def test_what_one_image_shows_joins_what_it_is_and_is_nothing_by_itself(world):
    labels = renamed(
        world.labels(sigma_px=0.3),
        lambda n, row: 50 + n if (row.frame_index, row.side) == (2, "left") and n in (4, 7) else n,
    )
    built, _ = build_map(labels, world)
    assert [decision.numbers for decision in built.decisions] == [(4, 54), (7, 57)]
    assert list(built.elements.id) == [3, 4, 7, 9]
    alone = [row for row in labels.rows() if not isinstance(row, LabelElement)]
    alone = [row for row in alone if labels.element(row.element_id).number not in (4, 7)]
    rest = [labels.element(element_id) for element_id in sorted({row.element_id for row in alone})]
    built, _ = build_map(Labels.from_rows([*rest, *alone]), world)
    assert list(built.elements.id) == [3, 9]
    assert {decision.reason for decision in built.decisions} == {"labelled in one image only"}


def test_what_is_hardly_known_is_not_in_the_map(make_world):
    far = make_world(
        {1: (1, np.array([300.0, 4.0, 2.5]), None), 2: (1, np.array([30.0, 4.0, 2.5]), None)}
    )
    built, _ = build_map(far.labels(0.5), far, BuildOptions(0.5, min_angle_deg=1e-3))
    assert list(built.elements.id) == [2]
    assert [decision.reason for decision in built.decisions] == [
        "where it stands is not known to 20 m"
    ]


def test_a_bottom_that_only_a_mistaken_label_shows_is_held(make_world):
    """The one label that knows it was drawn where the pole is behind the camera already."""
    far = (np.array([60.0, -6.0, 5.0]), np.array([60.0, -6.0, 0.5]))
    long = make_world({4: (0, *POLE), 5: (0, *far)}, count=13)
    labels = long.labels(sigma_px=0.3)
    own, others = (
        [row for row in labels.observations.values() if row.element_id == id_of(labels, number)]
        for number in (4, 5)
    )
    (mistake,) = (row for row in others if (row.frame_index, row.side) == (12, "left"))
    rows = [replace(row, end_known=False) for row in own]
    rows.append(replace(mistake, element_id=own[0].element_id))
    mixed = Labels.from_rows([labels.element(own[0].element_id), *rows])
    alone = triangulate_landmarks(*collect_observations(mixed, long)[:2])
    assert alone.ok.all()
    assert np.linalg.eigvalsh(alone.covariance_m2[0])[-1] < 1.0
    built, _ = build_map(mixed, long)
    assert len(built) == 1
    assert np.allclose(built.elements.anchor_m[0], POLE[0], atol=0.2)
    (left_out,) = decided(built, "leave out")
    assert left_out.observation_ids == (mistake.id,)

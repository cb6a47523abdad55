"""One planted fault for each rule, and nothing said of maps that are right."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from support.street_labels import careful, label_street

from semviz_annotation.labels.labels import (
    Dismissal,
    LabelElement,
    Labels,
    Observation,
    proposal_id,
)
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.lint import Finding, lint
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, MapFrame, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.research.evaluation.roads import move_element
from semviz_core.simulation.street import Street

FRAMES = range(0, 40, 2)
SECOND = "ffffffff-0000-8000-8000-000000000000"
"""A label element of a test's own."""


@dataclass(frozen=True, eq=False)
class Town:
    """A simulated street, its true map as made from labels that a careful person drew."""

    street: Street
    labels: Labels
    true: SemanticMap

    def find(self, semantic_map: SemanticMap, labels: Labels | None = None) -> list[Finding]:
        return list(lint(semantic_map, self.labels if labels is None else labels, self.street))

    def often_seen(self, *classes: int) -> int:
        """Id of the element of these classes that is labelled most."""
        counts = {
            int(number): sum(len(self.labels.of_element(id_)) for id_ in provenance.label_ids)
            for number, class_id, provenance in zip(
                self.true.elements.id, self.true.elements.class_id, self.true.provenance,
                strict=True,
            )
            if class_id in classes
        }  # fmt: skip
        return max(counts, key=lambda number: counts[number])

    def row(self, number: int) -> int:
        return self.true.elements.id.tolist().index(number)

    def labels_of(self, number: int) -> tuple[Observation, ...]:
        (label_id,) = self.true.provenance[self.row(number)].label_ids
        return self.labels.of_element(label_id)


@cache
def town(seed: int = 3) -> Town:
    street = Street(seed)
    given = label_street(careful(street, 0.5, seed), FRAMES, memory=1000)
    label_of = {given.truth[row.id].element_id: row.element_id
                for row in given.labels.observations.values()}  # fmt: skip
    provenance = tuple(
        Provenance((label_of[number],) if number in label_of else ())
        for number in street.truth_map.elements.id.tolist()
    )
    return Town(street, given.labels, replace(street.truth_map, provenance=provenance))


def changed(semantic_map: SemanticMap, number: int, **values: object) -> SemanticMap:
    """With one row of some arrays of the elements replaced."""
    elements = semantic_map.elements
    row = elements.id.tolist().index(number)
    arrays = dict(vars(elements))
    for name, value in values.items():
        arrays[name] = arrays[name].copy()
        arrays[name][row] = value
    return replace(semantic_map, elements=Elements3D(**arrays))


def with_copy(
    semantic_map: SemanticMap, number: int, by_m: object, **values: object
) -> SemanticMap:
    """With a second element beside one, 1000 higher by its id, of which there are no labels."""
    rows = [*range(len(semantic_map)), semantic_map.elements.id.tolist().index(number)]
    arrays = {name: array[rows].copy() for name, array in vars(semantic_map.elements).items()}
    arrays["id"][-1] += 1000
    arrays["anchor_m"][-1] += by_m
    arrays["end_m"][-1] += by_m
    for name, value in values.items():
        arrays[name][-1] = value
    provenance = (*semantic_map.provenance, Provenance())
    return replace(semantic_map, elements=Elements3D(**arrays), provenance=provenance)


def anchored(base: SemanticMap, number: int, above_m: object) -> SemanticMap:
    """A pole's peak put somewhere relative to its bottom."""
    bottom = base.elements.end_m[base.elements.id.tolist().index(number)]
    return changed(base, number, anchor_m=bottom + above_m)


def carried(base: SemanticMap, number: int, to_m: np.ndarray) -> SemanticMap:
    """Moved on the ground plane."""
    here = base.elements.anchor_m[base.elements.id.tolist().index(number), :2]
    return move_element(base, number, np.append(to_m[:2] - here, 0.0))


def mirrored(given: Town, number: int) -> SemanticMap:
    """To the other side of the road."""
    cameras = given.true.trajectory_m
    here = given.true.elements.anchor_m[given.row(number)]
    nearest = np.linalg.norm(cameras[:-1] - here, axis=1).argmin()
    ahead = cameras[nearest + 1] - cameras[nearest]
    left = np.array([-ahead[1], ahead[0], 0.0]) / np.linalg.norm(ahead[:2])
    return move_element(given.true, number, -2.0 * ((here - cameras[nearest]) @ left) * left)


def behind(given: Town, number: int) -> np.ndarray:
    """Behind the first camera that labels it, and as far aside as it is."""
    cameras = given.true.trajectory_m
    first = cameras[given.labels_of(number)[0].frame_index]
    ahead = (cameras[1] - cameras[0]) / np.linalg.norm(cameras[1] - cameras[0])
    return np.asarray(first - 12.0 * ahead + 8.0 * np.array([-ahead[1], ahead[0], 0.0]))


Plant = Callable[[Town, int], SemanticMap]
SIGNS = (TRIANGULAR, RECTANGULAR, ROUNDED)
PLANTS: list[tuple[str, str, tuple[int, ...], Plant]] = [
    ("leaning pole", "error", (POLE,), lambda t, n: anchored(t.true, n, (1.5, 0.0, 3.0))),
    ("leaning pole", "error", (POLE,), lambda t, n: anchored(t.true, n, (0.0, 0.0, -3.0))),
    ("leaning pole", "warning", (POLE,), lambda t, n: anchored(t.true, n, (0.4, 0.0, 3.0))),
    ("too short pole", "warning", (POLE,), lambda t, n: anchored(t.true, n, (0.0, 0.0, 0.7))),
    ("too short pole", "error", (POLE,), lambda t, n: anchored(t.true, n, (0.0, 0.0, 0.2))),
    ("too tall pole", "warning", (POLE,), lambda t, n: anchored(t.true, n, (0.0, 0.0, 20.0))),
    ("too tall pole", "error", (POLE,), lambda t, n: anchored(t.true, n, (0.0, 0.0, 50.0))),
    ("below ground", "error", (POLE,), lambda t, n: move_element(t.true, n, (0.0, 0.0, -2.0))),
    ("below ground", "error", SIGNS, lambda t, n: move_element(t.true, n, (0.0, 0.0, -5.0))),
    ("hovering", "warning", (POLE,), lambda t, n: move_element(t.true, n, (0.0, 0.0, 2.5))),
    ("hovering", "warning", SIGNS, lambda t, n: move_element(t.true, n, (0.0, 0.0, 12.0))),
    ("in the lane", "error", (POLE,), lambda t, n: carried(t.true, n, t.true.trajectory_m[20])),
    ("in the lane", "error", SIGNS, lambda t, n: carried(
        move_element(t.true, n, (0.0, 0.0, -1.0)), n, t.true.trajectory_m[20])),
    ("far from the road", "error", SIGNS, lambda t, n: move_element(t.true, n, (0.0, 400.0, 0.0))),
    ("behind the camera", "error", (POLE,), lambda t, n: carried(t.true, n, behind(t, n))),
    ("behind the camera", "error", SIGNS, lambda t, n: carried(t.true, n, behind(t, n))),
    ("wrong side of the road", "error", (POLE,), mirrored),
    ("wrong side of the road", "error", SIGNS, mirrored),
    ("sign without post", "hint", SIGNS, lambda t, n: move_element(t.true, n, (1.5, -1.5, 0.0))),
    ("class conflict", "error", (RECTANGULAR,), lambda t, n: changed(t.true, n, class_id=ROUNDED)),
    ("class conflict", "warning", (RECTANGULAR,), lambda t, n: with_copy(
        t.true, n, (0.1, 0.1, 0.0), class_id=ROUNDED)),
    ("duplicate nearby", "warning", (POLE,), lambda t, n: with_copy(t.true, n, (0.2, 0.0, 0.0))),
    ("duplicate nearby", "warning", SIGNS, lambda t, n: with_copy(t.true, n, (0.0, 0.0, 0.2))),
    ("duplicate nearby", "warning", SIGNS, lambda t, n: changed(
        with_copy(t.true, n, (1.0, 0.0, 0.0)), n, covariance_m2=np.diag([0.25] * 3 + [0.0] * 3))),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "severity", "classes", "plant"), PLANTS)
def test_a_planted_fault_is_found(rule, severity, classes, plant):
    given = town()
    number = given.often_seen(*classes)
    found = given.find(plant(given, number))
    mine = [finding for finding in found if number in finding.element_ids and finding.rule == rule]
    assert [finding.severity for finding in mine] == [severity]
    others = [
        finding
        for finding in found
        if number not in finding.element_ids and finding.severity != "hint"
    ]
    assert [other for other in others if other not in given.find(given.true)] == []
    name = given.true.classes.element_name(given.true.elements.class_id[given.row(number)], number)
    assert name[1:] in mine[0].message
    assert any(digit.isdigit() for digit in mine[0].message.replace(name, ""))
    shown_in = {row.frame_index for row in given.labels_of(number)}
    assert mine[0].frame_index in shown_in


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_truth_is_without_fault(seed):
    given = town(seed)
    for semantic_map in (given.true, given.street.truth_map):
        assert [
            finding for finding in given.find(semantic_map) if finding.severity == "error"
        ] == []
    said = given.find(given.true)
    assert {finding.rule for finding in said} <= {
        "ray angle too small"
    }  # what is far ahead at the end
    assert len(said) <= 0.15 * len(given.true)


def kept(labels: Labels, rows: list[Observation]) -> Labels:
    """With only these of one element's observations."""
    element_id = rows[0].element_id
    others = [row for row in labels.observations.values() if row.element_id != element_id]
    return Labels.from_rows([*labels.elements.values(), *others, *rows])


@pytest.mark.parametrize("classes", [(POLE,), SIGNS])
def test_rays_that_hardly_meet(classes):
    given = town()
    number = given.often_seen(*classes)
    first = given.labels_of(number)[0].frame_index
    pair = [row for row in given.labels_of(number) if row.frame_index == first]
    found = given.find(given.true, kept(given.labels, pair))
    narrow = [finding for finding in found if finding.rule == "ray angle too small"]
    assert number in {finding.element_ids[0] for finding in narrow}
    assert "deg apart" in narrow[0].message


def test_never_seen_again():
    given = town()
    number = given.often_seen(POLE)
    frames = sorted({row.frame_index for row in given.labels_of(number)})
    alone = frames[len(frames) // 2]
    pair = [row for row in given.labels_of(number) if row.frame_index == alone]
    labels = kept(given.labels, pair)
    found = [finding for finding in given.find(given.true, labels) if number in finding.element_ids]
    again = [finding for finding in found if finding.rule == "never seen again"]
    assert [(finding.severity, finding.frame_index) for finding in again] == [("warning", alone)]
    assert f"frame {alone - 2} and {alone + 2} should show it" in again[0].message
    hidden = [
        Dismissal(proposal_id(pair[0].element_id, index, "left"), index, "left", "occluded",
                  pair[0].element_id)
        for index in (alone - 2, alone + 2)
    ]  # fmt: skip
    said = Labels.from_rows([*labels.rows(), *hidden])
    assert "never seen again" not in {
        finding.rule for finding in given.find(given.true, said) if number in finding.element_ids
    }


def test_what_was_decided_about_a_pair_counts():
    """What a machine decided is a hint; what a person said is no news."""
    given = town()
    number = given.often_seen(POLE)
    twins = with_copy(given.true, number, (0.2, 0.0, 0.0))
    (label_id,) = given.true.provenance[given.row(number)].label_ids
    named = replace(twins, provenance=(*given.true.provenance, Provenance((SECOND,))))
    for by, expected in (("machine", ["hint"]), ("human", [])):
        decision = Decision("apart", (label_id, SECOND), (number, number + 1000), by, "they differ")
        found = lint(replace(named, decisions=(decision,)), Labels(), given.street)
        pairs = [finding for finding in found if finding.rule == "duplicate nearby"]
        assert [pair.severity for pair in pairs] == expected
        assert all("kept apart: they differ" in pair.message for pair in pairs)


def doubled(given: Town, number: int, class_id: int) -> Labels:
    """With every label of an element given a second time, as of a label element of its own."""
    again = [
        replace(row, id=f"{place:08x}-0000-8000-8000-000000000000", element_id=SECOND)
        for place, row in enumerate(given.labels_of(number))
    ]
    element = LabelElement(SECOND, number + 1000, class_id)
    return Labels.from_rows([*given.labels.rows(), element, *again])


def labelled_copy(given: Town, number: int, by_m: object, **values: object) -> SemanticMap:
    """As ``with_copy``, but of the second label element."""
    twins = with_copy(given.true, number, by_m, **values)
    return replace(twins, provenance=(*given.true.provenance, Provenance((SECOND,))))


def test_what_one_image_shows_twice_is_a_hint():
    given = town()
    number = given.often_seen(POLE)
    twins = labelled_copy(given, number, (0.05, 0.0, 0.0))
    found = given.find(twins, doubled(given, number, POLE))
    pairs = [finding for finding in found if finding.rule == "duplicate nearby"]
    assert [pair.severity for pair in pairs] == ["hint"]
    assert "labelled twice?" in pairs[0].message


VAGUE = np.diag([0.25] * 6)
"""m2: half a metre in each direction."""


def test_what_one_image_shows_is_two_landmarks():
    """Half a metre apart and vague, or of two classes on one post: no duplicate, no conflict."""
    given = town()
    number = given.often_seen(POLE)
    twins = labelled_copy(given, number, (0.5, 0.0, 0.0), covariance_m2=VAGUE)
    assert [
        finding.rule for finding in given.find(twins, Labels()) if number in finding.element_ids
    ] == ["duplicate nearby"]
    found = given.find(twins, doubled(given, number, POLE))
    assert [finding for finding in found if number in finding.element_ids] == []
    number = given.often_seen(RECTANGULAR)
    twins = labelled_copy(given, number, (0.1, 0.0, 0.0), class_id=ROUNDED)
    found = given.find(twins, doubled(given, number, ROUNDED))
    assert [finding for finding in found if number in finding.element_ids] == []


def hidden(base: SemanticMap, number: int) -> SemanticMap:
    return changed(base, number, end_known=False)


EXCUSES: list[tuple[str, tuple[int, ...], Plant]] = [
    ("short, but its bottom is hidden", (POLE,), lambda t, n: hidden(
        anchored(t.true, n, (0.0, 0.0, 0.7)), n)),
    ("high up, but its bottom is hidden", (POLE,), lambda t, n: hidden(
        move_element(t.true, n, (0.0, 0.0, 2.5)), n)),
    ("over the lane", SIGNS, lambda t, n: carried(
        move_element(t.true, n, (0.0, 0.0, 3.0)), n, t.true.trajectory_m[20])),
    ("leans by 8 deg, good to 9", (POLE,), lambda t, n: changed(
        anchored(t.true, n, (0.42, 0.0, 3.0)), n, covariance_m2=VAGUE / 2.0)),
    ("without a post, good to a metre", SIGNS, lambda t, n: changed(
        move_element(t.true, n, (1.0, 0.0, 0.0)), n, covariance_m2=np.diag([0.5] * 3 + [0.0] * 3))),
]  # fmt: skip


@pytest.mark.parametrize(("why", "classes", "plant"), EXCUSES)
def test_what_has_an_excuse_is_not_found(why, classes, plant):
    given = town()
    number = given.often_seen(*classes)
    told = {"in the lane", "hovering", "leaning pole", "too short pole", "sign without post"}
    over_the_lane = {"sign without post"} if why == "over the lane" else set()
    found = given.find(plant(given, number), Labels())
    rules = {finding.rule for finding in found if number in finding.element_ids}
    assert rules & told == over_the_lane


def test_maps_from_elsewhere_have_no_labels():
    """Rules about standing and about neighbours need none; a frame to look at is still told."""
    given = town()
    number = given.often_seen(POLE)
    bare = replace(given.true, provenance=(), trajectory_m=np.zeros((0, 3)))
    found = given.find(move_element(bare, number, (0.0, 0.0, -3.0)), Labels())
    assert [(finding.rule, finding.element_ids) for finding in found] == [
        ("below ground", (number,))
    ]
    frame = found[0].frame_index
    seen = np.concatenate([given.street.labels(frame, side)[1] for side in ("left", "right")])
    assert number in seen


def test_the_cameras_height_is_told_by_the_poles():
    """A lorry's camera is 2.95 m up; with fewer than five poles, 1.65 m is taken."""
    given = town()
    lorry = replace(given.true, trajectory_m=given.true.trajectory_m + np.array([0.0, 0.0, 1.3]))
    assert [finding for finding in given.find(lorry) if finding.severity == "error"] == []
    away = np.linalg.norm(lorry.trajectory_m[:, None, :2] - lorry.elements.end_m[:, :2], axis=2)
    nearest = np.argsort(away.min(axis=0))[:4]  # signs have no end, so they come last
    few = replace(lorry, elements=lorry.elements[nearest], provenance=())
    found = given.find(few, Labels())
    assert [finding.rule for finding in found] == ["below ground"] * 4


def test_the_worst_come_first():
    given = town()
    first, second = given.often_seen(POLE), given.often_seen(*SIGNS)
    both = move_element(move_element(given.true, second, (1.5, -1.5, 0.0)), first, (0.0, 0.0, -3.0))
    severities = [finding.severity for finding in given.find(both)]
    assert severities[0] == "error"
    assert severities[-1] == "hint"
    assert severities == sorted(severities, key=["error", "warning", "hint"].index)
    assert given.find(both) == given.find(both)


def test_frames_without_a_pose_are_left_alone(world):
    labels = world.labels()
    built, _ = build_map(labels, world)
    found = lint(built, labels, replace(world, count=3))
    assert [finding.message for finding in found] == [
        finding.message for finding in lint(built, labels, world)
    ]
    assert {finding.frame_index for finding in found} == {2}
    with pytest.raises(SemvizError, match="the map is of 'moon'"):
        lint(replace(built, frame=MapFrame("moon")), labels, world)


def test_nothing_to_look_at(world):
    empty = SemanticMap(Elements3D.from_ends([], [], [], []), world.map_frame)
    assert lint(empty, Labels(), world) == ()


@pytest.mark.parametrize("labelled", [True, False])
def test_what_is_no_geometry_is_still_looked_at(labelled):
    """A pole without length, a sign in the camera, one camera alone: findings, no crash."""
    given = town()
    pole, sign = given.often_seen(POLE), given.often_seen(*SIGNS)
    bottom = given.true.elements.end_m[given.row(pole)]
    odd = changed(given.true, pole, anchor_m=bottom, covariance_m2=np.zeros((6, 6)))
    odd = changed(odd, sign, anchor_m=given.true.trajectory_m[10])
    labels = given.labels if labelled else Labels()
    with np.errstate(all="raise", under="ignore"):
        found = given.find(odd, labels)
        given.find(replace(odd, trajectory_m=odd.trajectory_m[:1]), labels)
        given.find(replace(odd, elements=odd.elements[~odd.elements.is_line], provenance=()))
    rules = {
        (finding.rule, finding.element_ids[0]) for finding in found if finding.severity == "error"
    }
    assert {("too short pole", pole), ("in the lane", sign)} <= rules

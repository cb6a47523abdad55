"""What a detector found, as a person gets to see it: one thing, one offer, in both images."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semviz.annotator.session import LabelSession
from semviz.workspace import Workspace
from semviz_annotation.assist.shot import Mark
from semviz_annotation.detections import as_proposals
from semviz_annotation.labels import Observation, new_id
from semviz_annotation.proposals import Proposal, Proposals, save_proposals
from semviz_core.classes import ROUNDED, TRIANGULAR
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street


def look(session: LabelSession, frame: int) -> None:
    for question in session.unanswered(frame):
        session.looker.answer(question)


def true_finds(street: Street, frame: int, sides: Sequence[Side]) -> Proposals:
    """What a detector without fault finds, within 30 m and whole."""
    elements = street.truth_map.elements
    far_m = np.linalg.norm(elements.anchor_m - street.view(frame, "left").center_m, axis=1)
    near = elements.id[far_m < 30.0]
    found: list[Proposal] = []
    for side in sides:
        seen, ids = street.labels(frame, side)
        kept = np.isin(ids, near) & seen.anchor_known & (seen.end_known | ~seen.is_line)
        exact = replace(seen[kept], score=np.full(kept.sum(), 0.9))
        found += as_proposals(frame, side, exact, street.rig.left, "true")
    return Proposals.of(found)


def detector_offers(session: LabelSession, frame: int) -> list[dict[str, Any]]:
    return [one for one in session.frame(frame)["offers"] if one["origin"] == "detector"]


def accepted(session: LabelSession, frame: int, offers: list[dict[str, Any]]) -> None:
    """As the page accepts a detector's offers."""
    marks = [
        {
            "observation_id": offer[side]["id"],
            "element_id": offer["id"],
            "frame_index": frame,
            "side": side,
            "anchor_px": offer[side]["anchor"],
            "end_px": offer[side]["end"],
            "anchor_known": offer[side]["anchor_known"],
            "end_known": offer[side]["end_known"],
            "class_id": offer["class"],
        }
        for offer in offers
        for side in ("left", "right")
        if side in offer
    ]
    session.do(new_id(), {"kind": "accept", "marks": marks})


@pytest.mark.parametrize("sides", [("left", "right"), ("left",), ("right",)])
def test_a_detectors_find_is_one_offer_for_both_images(
    tmp_path: Path, sides: tuple[Side, ...]
) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 3))
    street = workspace.street
    detected = true_finds(street, 0, sides)
    save_proposals(detected, workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    both = [one for one in detector_offers(session, 0) if "left" in one and "right" in one]
    sure = [one for one in both if one["sure"]]
    assert len(sure) >= 0.6 * len(detected) / len(sides)
    accepted(session, 0, sure)
    assert len(session.labels.elements) == len(sure)
    assert len(session.elements_3d()) == len(sure)
    for element in session.labels.elements:
        rows = [session.labels.find(element, 0, side) for side in ("left", "right")]
        true = [[one for one in seen(street, row) if one is not None] for row in rows]
        assert set(true[0]) & set(true[1])
    assert not {one["id"] for one in sure} & {one["id"] for one in detector_offers(session, 0)}
    session.do(new_id(), {"kind": "undo"})
    look(session, 0)
    assert {one["id"] for one in sure} <= {one["id"] for one in detector_offers(session, 0)}
    session.close()


def seen(street: Street, row: Observation | None) -> list[int]:
    """The elements that a label lies on within 2 px."""
    assert row is not None
    marks, ids = street.labels(row.frame_index, row.side)
    drawn, end = Mark.of(row), marks.end_px
    found = []
    for n, name in enumerate(ids.tolist()):
        one = Mark(tuple(marks.anchor_px[n]), tuple(end[n]) if marks.is_line[n] else None)
        if one.is_line == drawn.is_line and drawn.gap_px(one) < 2.0:
            found.append(name)
    return found


def test_what_is_mapped_is_not_offered_again_as_something_new(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 3))
    finds = [true_finds(workspace.street, frame, ("left", "right")) for frame in range(2)]
    save_proposals(finds[0].joined(finds[1]), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    accepted(session, 0, detector_offers(session, 0))
    look(session, 1)
    offers = session.frame(1)["offers"]
    mapped = [one for one in offers if one["origin"] == "map"]
    assert mapped
    for new in detector_offers(session, 1):
        for side in ("left", "right"):
            near = [mark_of(one[side]) for one in mapped if side in one]
            if side in new:
                same = [one for one in near if one.is_line == mark_of(new[side]).is_line]
                assert all(mark_of(new[side]).gap_px(one) >= 6.0 for one in same)
    assert len(detector_offers(session, 1)) < 0.3 * len(mapped)
    session.close()


def mark_of(offered: dict[str, Any]) -> Mark:
    return Mark(tuple(offered["anchor"]), offered["end"] and tuple(offered["end"]))


def test_of_two_finds_of_one_place_the_surer_one_is_offered(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    found = [
        Proposal(
            new_id(), 0, "left", class_id, (700.0 + class_id, 120.0), None, True, False, s, 1.0
        )
        for class_id, s in ((ROUNDED, 0.5), (TRIANGULAR, 0.9))
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    (offer,) = detector_offers(session, 0)
    assert offer["class"] == TRIANGULAR
    session.close()

"""What a detector found, as a person gets to see it: one element, one proposal, in both images."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from annotator_page import SIDES, true_detections
from drawn_marks import do
from hypothesis import given, settings
from hypothesis import strategies as st
from streets import street_workspace
from support.street_labels import careful, label_street

from semviz.annotator.panes import Pane
from semviz.annotator.proposals.label_proposals import ImageSearchResult, LabelProposal, Origin
from semviz.annotator.proposals.proposal_selection import select_distinct
from semviz.annotator.proposals.proposal_views import ProposalMark, ProposalView
from semviz.annotator.session import LabelSession
from semviz.annotator.views import FrameSummary
from semviz_annotation.assist.marked_image import Mark, ProposedMark
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.edits import ReviewFrame
from semviz_annotation.labels.labels import Labels, Observation, new_id
from semviz_annotation.labels.proposal import ProcessedImages, Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_core.base.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.base.frame import Side
from semviz_core.simulation.street import Street


def look(session: LabelSession, frame: int) -> None:
    for question in session.pending_queries(frame):
        session.image_worker.search(question)


def detector_proposals(session: LabelSession, frame: int) -> list[ProposalView]:
    return [
        proposal for proposal in session.frame(frame).proposals if proposal.origin == "detector"
    ]


def accepted(session: LabelSession, frame: int, proposals: list[ProposalView]) -> None:
    """As the page accepts proposals."""
    marks = [
        {
            "observation_id": proposal.marks[side].id if is_new(proposal) else new_id(),
            "element_id": proposal.id,
            "frame_index": frame,
            "side": side,
            "anchor_px": proposal.marks[side].anchor,
            "end_px": proposal.marks[side].end,
            "anchor_known": proposal.marks[side].anchor_known,
            "end_known": proposal.marks[side].end_known,
        }
        | ({"class_id": proposal.class_id} if is_new(proposal) else {})
        for proposal in proposals
        for side in SIDES
        if side in proposal.marks
    ]
    if marks:
        do(session, {"kind": "accept", "marks": marks})


def is_new(proposal: ProposalView) -> bool:
    return bool(proposal.origin == "detector")


@pytest.mark.parametrize("sides", [SIDES, ("left",), ("right",)])
def test_a_detection_is_one_proposal_for_both_images(
    tmp_path: Path, sides: tuple[Side, ...]
) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 3)
    street = workspace.street
    detected = true_detections(street, 0, sides)
    save_proposals(detected, workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    both = [
        proposal
        for proposal in detector_proposals(session, 0)
        if "left" in proposal.marks and "right" in proposal.marks
    ]
    sure = [proposal for proposal in both if proposal.is_confident]
    assert len(sure) >= 0.6 * len(detected) / len(sides)
    accepted(session, 0, sure)
    assert len(session.labels.elements) == len(sure)
    assert all(session.position(element) is not None for element in session.labels.elements)
    for element in session.labels.elements:
        rows = [session.labels.find(element, 0, side) for side in SIDES]
        true = [[element for element in seen(street, row) if element is not None] for row in rows]
        assert set(true[0]) & set(true[1])
    assert not {proposal.id for proposal in sure} & {
        proposal.id for proposal in detector_proposals(session, 0)
    }
    do(session, {"kind": "undo"})
    look(session, 0)
    assert {proposal.id for proposal in sure} <= {
        proposal.id for proposal in detector_proposals(session, 0)
    }
    session.close()


def seen(street: Street, row: Observation | None) -> list[int]:
    """The elements that a label lies on within 2 px."""
    assert row is not None
    marks, ids = street.labels(row.frame_index, row.side)
    drawn, end = Mark.of(row), marks.end_px
    found = []
    for n, name in enumerate(ids.tolist()):
        mark = Mark(tuple(marks.anchor_px[n]), tuple(end[n]) if marks.is_line[n] else None)
        if drawn.gap_px(mark) < 2.0:
            found.append(name)
    return found


def test_mapped_elements_are_not_proposed_as_new(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 3)
    detections = [true_detections(workspace.street, frame, SIDES) for frame in range(2)]
    save_proposals(detections[0].joined(detections[1]), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    accepted(session, 0, detector_proposals(session, 0))
    look(session, 1)
    proposals = session.frame(1).proposals
    mapped = [proposal for proposal in proposals if proposal.origin == "map"]
    assert mapped
    for new in detector_proposals(session, 1):
        for side in SIDES:
            near = [mark_of(view.marks[side]) for view in mapped if side in view.marks]
            if side in new.marks:
                assert all(mark_of(new.marks[side]).gap_px(mark) >= 6.0 for mark in near)
    assert len(detector_proposals(session, 1)) < 0.3 * len(mapped)
    session.close()


def mark_of(proposed: ProposalMark) -> Mark:
    return Mark(proposed.anchor, proposed.end)


@st.composite
def marks(draw: st.DrawFn) -> tuple[str, int, tuple[float, float], tuple[float, float] | None]:
    """Side, class, anchor and end of something, often where something else is."""
    u = draw(st.sampled_from([400.0, 404.0, 420.0, 800.0]) | st.floats(20.0, 1200.0))
    v = draw(st.sampled_from([100.0, 103.0]) | st.floats(20.0, 200.0))
    class_id = draw(st.sampled_from([POLE, ROUNDED, TRIANGULAR]))
    end = (u + draw(st.floats(-4.0, 4.0)), v + draw(st.floats(20.0, 150.0)))
    side = draw(st.sampled_from(SIDES))
    return side, class_id, (u, v), end if class_id == POLE else None


@settings(max_examples=8, deadline=None)
@given(st.lists(marks(), max_size=4), st.lists(marks(), min_size=1, max_size=12, unique=True))
def test_whatever_a_detector_finds_what_a_person_drew_stays(
    drawn: list[tuple[Side, int, tuple[float, float], tuple[float, float] | None]],
    found: list[tuple[Side, int, tuple[float, float], tuple[float, float] | None]],
) -> None:
    """Also when all is accepted, of which nothing lies where something is labelled."""
    with TemporaryDirectory() as folder:
        workspace = street_workspace(Path(folder) / "street", 7, 2)
        rows = [
            Proposal(new_id(), 0, side, class_id, at, end, True, end is not None, 0.9, 2.0)
            for side, class_id, at, end in found
        ]
        save_proposals(Proposals.of(rows), workspace.proposals_path)
        session = LabelSession(workspace, "tester")
        for side, class_id, at, end in drawn:
            element = {"kind": "draw", "observation_id": new_id(), "element_id": new_id()}
            where = {"frame_index": 0, "side": side, "anchor_px": at, "end_px": end}
            do(session, element | where | {"class_id": class_id})
        before = dict(session.labels.observations)
        look(session, 0)
        for proposal in detector_proposals(session, 0):
            for row in before.values():
                shown = proposal.marks.get(row.side)
                assert shown is None or mark_of(shown).gap_px(Mark.of(row)) >= 6.0
        accepted(session, 0, session.frame(0).proposals)
        assert before.items() <= dict(session.labels.observations).items()
        seen = [(row.element_id, row.side) for row in session.labels.in_frame(0)]
        assert len(seen) == len(set(seen))
        session.close()


def test_the_better_of_two_detections_in_one_position_is_proposed(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, 2)
    found = [
        Proposal(
            new_id(), 0, "left", class_id, (700.0 + class_id, 120.0), None, True, False, s, 1.0
        )
        for class_id, s in ((ROUNDED, 0.5), (TRIANGULAR, 0.9))
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    (proposal,) = detector_proposals(session, 0)
    assert proposal.class_id == TRIANGULAR
    session.close()


def learnt(session: LabelSession, frame: int) -> FrameSummary:
    """What the jump lists say of a frame."""
    while not session.analyze(1.0):
        pass
    return next(view for view in session.summary().frames if view.index == frame)


def test_disagreement_of_detector_and_labels_names_the_worst_element(tmp_path: Path) -> None:
    """Planted: a false positive in frame 1; in frame 2 a labelled pole is not detected."""
    workspace = street_workspace(tmp_path / "street", 7, 4)
    street = workspace.street
    see = careful(street, 1e-6, 0)
    labels = label_street(see, range(4), 4).labels
    with workspace.open_labels() as store:
        rows = tuple(labels.elements.values()), tuple(labels.observations.values())
        store.apply(ImportLabels(*rows), "tester")
        for frame in range(4):
            store.apply(ReviewFrame(frame, "reviewed"), "tester")
    poles = [row for row in labels.in_frame(2, "left") if row.end_px is not None]
    missed = max(poles, key=lambda row: row.end_px[1] - row.anchor_px[1])
    found = [
        proposal
        for frame in range(4)
        for side in SIDES
        for proposal in as_proposals(
            frame, side, see(frame, side).observed, street.rig.left, "true", "centroid"
        )
        if not any(
            row.side == side and np.hypot(*np.subtract(row.anchor_px, proposal.anchor_px)) < 1.0
            for row in labels.of_element(missed.element_id)
            if row.frame_index == frame == 2
        )
    ]
    planted = Proposal(new_id(), 1, "left", ROUNDED, (620.0, 330.0), None, True, False, 0.7, 1.0)
    planted = replace(planted, detector="true")
    looked = ProcessedImages(
        "true", images=frozenset((frame, side) for frame in range(3) for side in SIDES)
    )
    save_proposals(Proposals.of([*found, planted], looked), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    first, second, three = (learnt(session, frame).disagreement for frame in (0, 1, 2))
    assert (first.new, first.missed, first.weight) == (0, 0, 0.0)
    assert (second.new, second.missed, second.weight) == (1, 0, 0.7)
    assert (three.new, three.missed) == (0, 1)
    assert three.worst_id == missed.element_id
    assert three.weight > second.weight
    assert learnt(session, 3).disagreement is None  # the detector did not look at it
    down = {"id": planted.id, "frame_index": 1, "side": "left", "why": "rejected"}
    do(session, {"kind": "dismiss", "dismissals": [down | {"element_id": None}]})
    session.updates()
    assert learnt(session, 1).disagreement.weight == 0.0
    session.close()


@pytest.mark.parametrize("paired", [True, False])
def test_a_rejected_detection_does_not_come_back_as_another(tmp_path: Path, paired: bool) -> None:
    """One element that was found in both images, whether or not anybody knew that it is one."""
    workspace = street_workspace(tmp_path / "street", 7, 2)
    rows = true_detections(workspace.street, 0, SIDES).rows()
    if not paired:  # the same mark twice: two could be the correspondence
        rows += tuple(replace(row, id=new_id()) for row in rows)
    save_proposals(Proposals.of(rows), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    proposals = [
        proposal
        for proposal in detector_proposals(session, 0)
        if all(side in proposal.marks for side in SIDES)
    ]
    assert proposals
    for proposal in proposals:
        down = [
            {"id": proposal.marks[side].id, "frame_index": 0, "side": side, "why": "rejected"}
            for side in SIDES
        ]
        down = [dismissal | {"element_id": None} for dismissal in down]
        do(session, {"kind": "dismiss", "dismissals": down})
        look(session, 0)
        for other in detector_proposals(session, 0):
            for side in SIDES:
                if side in other.marks:
                    assert mark_of(other.marks[side]).gap_px(mark_of(proposal.marks[side])) >= 6.0
    session.close()


def reject(session: LabelSession, frame: int, proposal: ProposalView, why: str) -> None:
    """As the page rejects a proposal."""
    down = [
        {"id": proposal.marks[side].id, "frame_index": frame, "side": side, "why": why}
        for side in SIDES
        if side in proposal.marks
    ]
    down = [dismissal | {"element_id": None} for dismissal in down]
    do(session, {"kind": "dismiss", "dismissals": down})


def near(proposals: list[ProposalView], marks: dict[Side, Mark]) -> list[ProposalView]:
    """Those that lie at marks, in each image."""
    return [
        proposal
        for proposal in proposals
        if all(
            side in proposal.marks
            and side in marks
            and mark_of(proposal.marks[side]).gap_px(marks[side]) < 2.0
            for side in SIDES
        )
    ]


def test_a_detection_rejected_in_one_frame_is_not_confident_in_others(tmp_path: Path) -> None:
    """But it is proposed; an element hidden in one frame stays confident in others."""
    workspace = street_workspace(tmp_path / "street", 7, 3)
    street = workspace.street
    detections = true_detections(street, 0, SIDES).joined(true_detections(street, 2, SIDES))
    save_proposals(detections, workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    look(session, 0)
    look(session, 2)
    first, before = (confident(detector_proposals(session, frame)) for frame in (0, 2))
    proposal, there = next(
        (proposal, there)
        for proposal in first
        for element in at_mark(street, 0, "left", proposal.marks["left"])
        if near(before, there := true_marks(street, 2, element))
    )
    for why, stays in (("rejected", False), ("absent", False), ("occluded", True)):
        reject(session, 0, proposal, why)
        (again,) = near(detector_proposals(session, 2), there)
        assert again.is_confident == stays
        sure = {proposal.id for proposal in confident(detector_proposals(session, 2))}
        assert sure >= {proposal.id for proposal in before} - {again.id}
        do(session, {"kind": "undo"})
        assert confident(near(detector_proposals(session, 2), there))
    session.close()


def confident(proposals: list[ProposalView]) -> list[ProposalView]:
    return [proposal for proposal in proposals if proposal.is_confident]


def at_mark(street: Street, frame: int, side: Side, shown: ProposalMark) -> list[int]:
    """The elements within 2 px of a mark."""
    _, ids = street.labels(frame, side)
    marks = {id_: true_marks(street, frame, id_).get(side) for id_ in ids.tolist()}
    return [
        element for element, mark in marks.items() if mark and mark_of(shown).gap_px(mark) < 2.0
    ]


def true_marks(street: Street, frame: int, element: int) -> dict[Side, Mark]:
    """Where an element is seen."""
    found: dict[Side, Mark] = {}
    for side in SIDES:
        marks, ids = street.labels(frame, side)
        for row in np.flatnonzero(ids == element):
            end = tuple(marks.end_px[row]) if marks.is_line[row] else None
            found[side] = Mark(tuple(marks.anchor_px[row]), end)
    return found


@pytest.mark.parametrize(
    ("origin", "depth_m", "sure"),
    [
        ("detector", 50.0, True),
        ("detector", 70.0, False),
        ("detector", None, True),
        ("map", 70.0, True),
    ],
)
def test_what_a_detector_found_too_far_ahead_to_label_is_never_sure(
    origin: Origin, depth_m: float | None, sure: bool
) -> None:
    proposal = LabelProposal(
        "id", Pane(0, "left"), POLE, origin, "element", Mark((1.0, 2.0), (1.0, 50.0))
    )
    answered = proposal.with_result(
        ImageSearchResult(ProposedMark(Mark((1.0, 2.0), (1.0, 50.0)), 0.9), None, depth_m)
    )
    assert answered.is_confident == sure


@pytest.mark.parametrize(
    ("aside_px", "score", "seen"),
    [
        ((0.5, 0.5), 0.9, True),
        ((0.5, 3.0), 0.9, False),
        ((0.5, 0.5), 0.7, False),
        ((0.5,), 0.9, False),
    ],
)
def test_a_find_adds_the_peak_that_nobody_saw_before_and_moves_nothing_else(
    aside_px: tuple[float, ...], score: float, seen: bool
) -> None:
    """Where it lies on the line of what is followed in both images; in one, two may do so."""
    followed = Mark((500.0, 130.0), (500.0, 220.0), False, False)
    proposals = [
        LabelProposal(side, Pane(0, side), POLE, "map", "element", followed, 0.95) for side in SIDES
    ]
    for side, aside in zip(SIDES, aside_px, strict=False):
        found = Mark((500.0 + aside, 110.0), (500.0 + aside, 223.0), True, True)
        proposals.append(
            LabelProposal("new", Pane(0, side), POLE, "detector", "thing", found, score)
        )
    known = select_distinct(proposals, Labels())
    for proposal in known:
        peak = replace(followed, anchor_px=(500.5, 110.0), anchor_known=True)
        assert proposal.mark == (peak if seen else followed)
        assert proposal.element_id == "element"
    assert len(known) == 2

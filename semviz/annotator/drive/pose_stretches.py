"""Say what is wrong with the poses of some frames, what can be done, and what that changes."""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from semviz.web.protocol import Part
from semviz.workspace.poses.pose_choices import Choice, Subject
from semviz.workspace.poses.pose_labels import FrameAgreement
from semviz.workspace.poses.pose_review import PoseReview, PoseStretch
from semviz_core.pose_checks.faults import PoseFault

TURNS = (("down", "up"), ("left", "right"), ("counterclockwise", "clockwise"))
"""Where a turn about each camera axis leads: negative, positive."""
Agreements: TypeAlias = Mapping[int, FrameAgreement]


class PoseFact(Part):
    """A line of facts about a stretch."""

    name: str
    value: str


class PoseAnswer(Part):
    """What a person may choose, and what it costs."""

    choice: Choice
    title: str
    price: str
    preview: str
    """What the bar says before it is confirmed."""
    refusal: str
    """Why it cannot be chosen; empty if it can."""


class PoseEffect(Part):
    """A figure before and after refining."""

    name: str
    before: str
    after: str


class MovedElement(Part):
    """An element that refining moves."""

    id: str
    name: str
    class_id: int
    moved_m: float
    before_px: float | None
    after_px: float | None


class StretchView(Part):
    """A fault of poses: what is wrong, what can be done, and what that changes."""

    first: int
    last: int
    subject: Subject
    where: str
    title: str
    sentence: str
    sigmas: float | None
    """How far the poses are from the images."""
    facts: list[PoseFact]
    answers: list[PoseAnswer]
    effects: list[PoseEffect]
    moved: list[MovedElement]
    chosen: Choice | None
    chosen_by: str


def _where(fault: PoseFault) -> str:
    return (
        f"frame {fault.first}"
        if fault.first == fault.last
        else f"frames {fault.first}–{fault.last}"
    )


def _title(fault: PoseFault, review: PoseReview) -> str:
    """Return ``The first 12 poses are turned``."""
    frames = review.check.frames
    count = sum(fault.first <= frame.index <= fault.last for frame in frames)
    words = {"turned": "turned", "shifted": "shifted", "frozen": "frozen"}
    if fault.kind in words:
        one, verb = count == 1, "is" if count == 1 else "are"
        name = f"The pose of frame {fault.first}" if one else f"Poses {fault.first}–{fault.last}"
        if not one and fault.first == frames[0].index:
            name = f"The first {count} poses"
        elif not one and fault.last == frames[-1].index:
            name = f"The last {count} poses"
        return f"{name} {verb} {words[fault.kind]}"
    return {
        "axes": "The axes of the poses are wrong",
        "time": "The poses are of another time than the images",
        "heights": "All heights are the same",
        "baseline": "Poses and stereo differ in scale",
        "right image": "The right image is shifted",
    }[fault.kind]


def stretch_view(stretch: PoseStretch, review: PoseReview, agreements: Agreements) -> StretchView:
    """Return the page's view of a fault; ``agreements`` are those of all labelled frames."""
    fault, operation = stretch.fault, review.choice_for(stretch)
    return StretchView(
        first=fault.first,
        last=fault.last,
        subject=stretch.subject,
        where=_where(fault),
        title=_title(fault, review),
        sentence=_explained(stretch, agreements),
        sigmas=_sigmas(stretch),
        facts=_facts(stretch, review, agreements),
        answers=_answers(stretch),
        effects=_effects(stretch),
        moved=_moved(stretch),
        chosen=None if operation is None else operation.choice,
        chosen_by="" if operation is None else operation.author,
    )


def _explained(stretch: PoseStretch, agreements: Agreements) -> str:
    """Return the sentence that says whose fault it is."""
    fault = stretch.fault
    if stretch.subject != "frames":
        return f"{fault.text[0].upper()}{fault.text[1:]}."
    evidence = None if stretch.seen is None else stretch.seen.evidence
    _, angle, word = _turn(stretch)
    side = f"to the {word}" if word in ("left", "right") else word
    moved = f"the camera is turned by up to {angle:.2f}° {side}"
    if fault.shift_m >= 0.05:
        moved += f", and shifted by up to {fault.shift_m:.2f} m"
    if fault.kind == "frozen":
        moved = "the pose stands still while the images move"
    if evidence is None:
        return (
            f"The images of {_where(fault)} show another motion than the poses: {moved}. "
            "No label says anything about it."
        )
    inside = [one for one in agreements.values() if fault.first <= one.frame <= fault.last]
    together = max((one.together_px for one in inside), default=evidence.before_px)
    alone = float(np.median([one.alone_px for one in inside])) if inside else evidence.after_px
    count = f"{evidence.agreeing} of {evidence.elements}"
    if evidence.agreeing == evidence.elements:
        count = f"all {evidence.elements}"
    return (
        f"In {_where(fault)}, {count} elements jump together, by up to {together:.1f} px; one "
        f"against another they move {alone:.1f} px. That is the pose, not the labels: {moved}."
    )


def _sigmas(stretch: PoseStretch) -> float | None:
    """Return how far the worst pair of frames is from the images."""
    if stretch.fault.sigmas is not None:
        return round(stretch.fault.sigmas, 1)
    comparison = stretch.check.comparison
    numbers = [frame.index for frame in stretch.check.frames]
    rows = [
        row
        for row, index in enumerate(numbers)
        if stretch.fault.first <= index <= stretch.fault.last
    ]
    pairs = slice(max(rows[0] - 1, 0), rows[-1] + 1)
    chi2 = comparison.chi2[pairs]
    return round(float(np.sqrt(chi2.max())), 1) if len(chi2) and chi2.max() > 0.0 else None


def _facts(stretch: PoseStretch, review: PoseReview, agreements: Agreements) -> list[PoseFact]:
    fault = stretch.fault
    rows: list[tuple[str, str]] = []
    if stretch.subject == "frames":
        rows += _frame_facts(stretch, agreements)
    elif fault.value is not None:
        rows.append(("Measured", _measured(fault)))
    rows += [
        ("Labels in these frames", f"{stretch.label_count}"),
        ("Poses are from", _pose_source(review)),
    ]
    return [PoseFact(name=name, value=value) for name, value in rows]


def _measured(fault: PoseFault) -> str:
    unit = {"time": "frames", "heights": "m", "baseline": "m", "right image": "px"}.get(fault.kind)
    return f"{fault.value:g} {unit or ''}".strip()


def _frame_facts(stretch: PoseStretch, agreements: Agreements) -> list[tuple[str, str]]:
    fault = stretch.fault
    inside = [one for index, one in agreements.items() if fault.first <= index <= fault.last]
    outside = [one for index, one in agreements.items() if not fault.first <= index <= fault.last]
    facts = []
    if inside:
        worst = max(inside, key=lambda one: one.together_px)
        facts.append((f"Common shift, frame {worst.frame}", _direction_px(worst.shift_px)))
    frame, angle, word = _turn(stretch)
    facts.append((f"Common turn, frame {frame}", f"{angle:.2f}° {word}"))
    facts.append(("Largest shift", f"{fault.shift_m:.2f} m"))
    if inside:
        alone = float(np.median([one.alone_px for one in inside]))
        facts.append(("What stays of one element", f"{alone:.1f} px"))
    if outside:
        good = float(np.median([one.together_px for one in outside]))
        facts.append(("All together, other frames", f"{good:.1f} px"))
    return facts


def _turn(stretch: PoseStretch) -> tuple[int, float, str]:
    """Return the frame that is turned most, by how much (deg), and where to."""
    fault, check = stretch.fault, stretch.check
    turn = check.refinement.turn_rad
    numbers = [frame.index for frame in check.frames]
    rows = [row for row, index in enumerate(numbers) if fault.first <= index <= fault.last]
    row = max(rows, key=lambda row: float(np.linalg.norm(turn[row])))
    axis = int(np.abs(turn[row]).argmax())
    word = TURNS[axis][1 if turn[row, axis] > 0.0 else 0]
    return numbers[row], float(np.rad2deg(np.linalg.norm(turn[row]))), word


def _direction_px(shift_px: tuple[float, float]) -> str:
    u, v = shift_px
    return (
        f"{abs(u):.1f} px {'right' if u > 0 else 'left'}, {abs(v):.1f} px "
        f"{'down' if v > 0 else 'up'}"
    )


def _pose_source(review: PoseReview) -> str:
    settings = review.workspace.settings.source
    poses = getattr(settings, "poses", None)
    if poses is not None:
        return str(poses).rsplit("/", 1)[-1]
    sequence = getattr(settings, "sequence", None)
    return "the import" if sequence is None else f"poses/{sequence}.txt"


def _answers(stretch: PoseStretch) -> list[PoseAnswer]:
    """Return the three answers, or the one that a fault of the calibration has."""
    keep = _keep(stretch)
    if not stretch.can_refine:
        return [keep]
    if stretch.subject != "frames":
        return [_refine(stretch), keep]
    return [_refine(stretch), _leave_out(stretch), keep]


def _refine(stretch: PoseStretch) -> PoseAnswer:
    fault, evidence = stretch.fault, None if stretch.seen is None else stretch.seen.evidence
    moves = f"up to {fault.turn_deg:.2f}° and {fault.shift_m:.2f} m"
    which = f"Poses {fault.first}–{fault.last} move by {moves}. No label and no other pose changes."
    if stretch.subject != "frames":
        which = (
            "All poses become those that the images show, near the given ones. No label changes."
        )
    refusal, figures = "", ""
    if evidence is not None:
        figures = f": {evidence.before_px:.1f} px → {evidence.after_px:.1f} px"
        if evidence.grows_worse:
            refusal = (
                f"Refining makes the labels kept back worse ({evidence.before_px:.1f} → "
                f"{evidence.after_px:.1f} px). Nothing was changed."
            )
    return PoseAnswer(
        choice="refine",
        title="Refine these poses",
        price=f"{which} One operation, undone by Ctrl Z.",
        preview=f"Trying {_where(fault)} with poses refined from the images{figures}. "
        "Nothing is changed.",
        refusal=refusal,
    )


def _leave_out(stretch: PoseStretch) -> PoseAnswer:
    count, lost = stretch.label_count, list(stretch.lost)
    price = f"{count} labels stay and do not count."
    if lost:
        names = ", ".join(lost[:4]) + (f" and {len(lost) - 4} more" if len(lost) > 4 else "")
        verb = "is" if len(lost) == 1 else "are"
        leaves = "leaves" if len(lost) == 1 else "leave"
        price += f" {names} {verb} hardly seen elsewhere and {leaves} the map."
    return PoseAnswer(
        choice="leave out",
        title="Leave them out of the map",
        price=price,
        preview=f"Trying without the poses of {_where(stretch.fault)}: {price} Nothing is changed.",
        refusal="",
    )


def _keep(stretch: PoseStretch) -> PoseAnswer:
    moves = stretch.moves
    price = "Not asked again."
    if moves:
        price += f" {len(moves)} elements keep up to {moves[0].moved_m:.2f} m of error."
    elif not stretch.can_refine:
        price = f"Not asked again. To repair it: {stretch.fault.remedy}."
    return PoseAnswer(
        choice="keep",
        title="Keep as they are",
        price=price,
        preview=f"Keeping {_where(stretch.fault)} as they are. {price}",
        refusal="",
    )


def _effects(stretch: PoseStretch) -> list[PoseEffect]:
    if not stretch.can_refine:
        return []
    evidence = None if stretch.seen is None else stretch.seen.evidence
    rows: list[tuple[str, str, str]] = []
    if evidence is not None:
        rows.append(
            (
                f"Labels of {evidence.elements} elements, not used",
                f"{evidence.before_px:.1f} px",
                f"{evidence.after_px:.1f} px",
            )
        )
    fault = stretch.fault
    if stretch.subject == "frames":
        good = np.rad2deg(stretch.check.comparison.pose_sigma[3:].max())
        rows.append(("Turn against the images", f"{fault.turn_deg:.2f}°", f"{good:.2f}°"))
        rows.append(("Shift against the images", f"{fault.shift_m:.2f} m", "0.00 m"))
    rows.append(("Labels changed", "", "none"))
    return [PoseEffect(name=name, before=before, after=after) for name, before, after in rows]


def _moved(stretch: PoseStretch) -> list[MovedElement]:
    moved = []
    for move in stretch.moves:
        element = stretch.labels.element(move.element_id)
        before = after = None
        if stretch.seen is not None:
            before, after = stretch.seen.errors_of(move.element_id)
        moved.append(
            MovedElement(
                id=element.id,
                name=stretch.labels.classes.element_name(element.class_id, element.number),
                class_id=element.class_id,
                moved_m=round(move.moved_m, 3),
                before_px=before,
                after_px=after,
            )
        )
    return moved

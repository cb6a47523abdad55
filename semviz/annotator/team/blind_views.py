"""What the view "Team" shows of frames that two people label blind, and what it asks for."""

from typing import Annotated, Literal

from pydantic import Field

from semviz.annotator.team.blind_shares import BlindShares, ShareProgress
from semviz.annotator.team.team_view import AssignedFrame, TeamView
from semviz.annotator.views import ObservationView, label_element_name, observation_view
from semviz.web.protocol import Event, Part, Request
from semviz_annotation.labels.agreement import ElementPair, LabelAgreement, ViewPair, mean_label
from semviz_core.base.classes import ClassSet
from semviz_core.base.frame import Side

SAME_PX = 0.005
"""Labels that are so near come from one proposal, accepted by both."""


class AgreementView(Part):
    """How the labels of two people agree, in frames that both have reviewed."""

    frames: int
    elements: int
    both: int
    """Elements that both labelled."""
    missed: tuple[int, int]
    """Elements of the other that the first, and the second, did not label."""
    other_class: int
    """Of those that both labelled, how many have two classes."""
    labels: int
    """Images of an element that both labelled."""
    same_ends: int
    """Of these, how many agree on which ends are hidden."""
    identical: int
    """Of these, how many are at the same place: accepted from one proposal, most likely."""
    pole_angle_deg: list[float]
    """Ascending, as are the next two."""
    pole_px: list[float]
    sign_px: list[float]


class ShareView(Part):
    """Frames that two people label blind."""

    number: int
    people: tuple[str, str]
    frames: list[int]
    reviewed: tuple[int, int]
    """Frames that the first, and the second, has reviewed."""
    ready: list[int]
    """Frames to be merged: both have reviewed them."""
    worst_px: list[float]
    """Of these, how far the labels are apart that are farthest apart; 0 for who does not review."""
    merged: int
    agreement: AgreementView | None
    """None while no frame is compared, and for who does not review."""


class TeamEvent(Event):
    """The work of all."""

    type: Literal["team"] = "team"
    team: TeamView
    shares: list[ShareView]


class ComparedView(Part):
    """One element in one image, as two people labelled it, and the mean if there is one."""

    side: Side
    first: ObservationView | None
    second: ObservationView | None
    mean: ObservationView | None
    px: float | None
    angle_deg: float | None
    """Of poles that both labelled."""


class ComparedElement(Part):
    """One element of a frame, as two people labelled it."""

    id: str
    """Of the first's element, or the second's if that is the only one."""
    names: tuple[str, str]
    """In their own files; empty for who did not label it."""
    classes: tuple[int | None, int | None]
    views: list[ComparedView]
    apart: str
    """What differs; empty if nothing that needs a decision does."""


class AssignShareRequest(Request):
    """Let two people label a share of a range of frames, each without seeing the other's labels."""

    type: Literal["assign_share"] = "assign_share"
    frames: tuple[AssignedFrame, AssignedFrame]
    percent: Annotated[float, Field(gt=0.0, le=100.0)]
    people: tuple[str, str]


class EndShareRequest(Request):
    """Let these frames be labelled as all others again."""

    type: Literal["end_share"] = "end_share"
    number: int


class ShowComparedRequest(Request):
    """Request two versions of a frame: of two people who labelled it blind, or earlier and now."""

    type: Literal["show_compared"] = "show_compared"
    frame: int


class OpenShareRequest(Request):
    """Request the address where one labels one's own frames blind."""

    type: Literal["open_share"] = "open_share"


class ComparedEvent(Event):
    """Two versions of a frame, what differs most first."""

    type: Literal["compared"] = "compared"
    frame: int
    people: tuple[str, str]
    """Who labelled them; empty if there is one version only."""
    times: tuple[str, str]
    """Of the earlier version, and of the present one; empty of frames labelled blind."""
    is_blind: bool
    """Whether it is to be merged."""
    elements: list[ComparedElement]
    """Of an earlier version those that have changed since."""


class ShareOpenedEvent(Event):
    """Where one labels one's own frames blind."""

    type: Literal["share_opened"] = "share_opened"
    address: str


APART_PX = 3.0
"""Labels farther apart need a decision; nearer ones may be averaged without a look."""


def share_views(shares: BlindShares, reviews: bool) -> list[ShareView]:
    """Return all shares; with the agreement for who ``reviews``."""
    return [_share_view(shares.progress(share), shares, reviews) for share in shares.all]


def _share_view(progress: ShareProgress, shares: BlindShares, reviews: bool) -> ShareView:
    share = progress.share
    seen = reviews and progress.both
    ready = [frame for frame in progress.both if frame not in progress.merged]
    return ShareView(
        number=share.number,
        people=share.people,
        frames=list(share.frames),
        reviewed=progress.reviewed,
        ready=ready,
        worst_px=[shares.worst_px(share, frame) if reviews else 0.0 for frame in ready],
        merged=len(progress.merged),
        agreement=agreement_view(shares.agreement(progress)) if seen else None,
    )


def agreement_view(agreement: LabelAgreement) -> AgreementView:
    """Return the figures of an agreement; angles in degrees."""
    poles, signs = agreement.distances(True), agreement.distances(False)
    px = [*poles[:, 0], *signs[:, 0]]
    return AgreementView(
        frames=agreement.frames,
        elements=len(agreement.pairs),
        both=len(agreement.both),
        missed=agreement.missed,
        other_class=agreement.class_disagreements,
        labels=len(agreement.views),
        same_ends=sum(view.same_ends for view in agreement.views),
        identical=sum(value < SAME_PX for value in px),
        pole_angle_deg=sorted(float(value) for value in 57.29577951308232 * poles[:, 1]),
        pole_px=sorted(map(float, poles[:, 0])),
        sign_px=sorted(map(float, signs[:, 0])),
    )


def compared_event(
    shares: BlindShares, frame: int, classes: ClassSet, reply_to: str
) -> ComparedEvent:
    """Return what two people labelled blind in a frame, if it is labelled twice and not merged.

    Else its version before the present one, and the present one.
    """
    found = shares.compared(frame)
    people = found.people
    return ComparedEvent(
        reply_to=reply_to,
        frame=frame,
        people=people,
        times=found.times,
        is_blind=found.is_blind,
        elements=[
            _compared_element(pair, people, classes, found.differing(pair)) for pair in found.pairs
        ],
    )


def _compared_element(
    pair: ElementPair, people: tuple[str, str], classes: ClassSet, attributes: str
) -> ComparedElement:
    both = pair.first, pair.second
    element = pair.first or pair.second
    assert element is not None
    first, second = (label_element_name(one, classes) if one else "" for one in both)
    mine, theirs = (one.class_id if one else None for one in both)
    return ComparedElement(
        id=element.id,
        names=(first, second),
        classes=(mine, theirs),
        views=[_compared_view(view, pair.same_class) for view in pair.views],
        apart=_apart(pair, people) or attributes,
    )


def _compared_view(view: ViewPair, same_class: bool) -> ComparedView:
    first, second, found = view.first, view.second, view.distance
    mean = None
    if first is not None and second is not None and same_class and view.same_ends:
        mean = mean_label(first, second)
    is_pole = first is not None and first.end_px is not None
    return ComparedView(
        side=view.side,
        first=None if first is None else observation_view(first),
        second=None if second is None else observation_view(second),
        mean=None if mean is None else observation_view(mean),
        px=None if found is None else found.px,
        angle_deg=57.29577951308232 * found.angle_rad if found and is_pole else None,
    )


def _apart(pair: ElementPair, people: tuple[str, str]) -> str:
    """Return what differs between two people's labels of one element."""
    for element, name in zip((pair.first, pair.second), people, strict=True):
        if element is None:
            return f"{name} did not label it"
    if not pair.same_class:
        return "two classes"
    for view in pair.views:
        for row, name in zip((view.first, view.second), people, strict=True):
            if row is None:
                return f"{name} did not label it in the {view.side} image"
        if not view.same_ends:
            return f"hidden ends differ in the {view.side} image"
    return f"{pair.worst_px:.1f} px apart" if pair.worst_px > APART_PX else ""

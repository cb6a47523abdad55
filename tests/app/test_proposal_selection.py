"""Which proposals of known elements count as duplicates."""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from semviz.annotator.panes import Pane
from semviz.annotator.proposals.label_proposals import LabelProposal
from semviz.annotator.proposals.proposal_selection import TAKEN_PX, select_distinct
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import Labels

POLE, ROUND = 0, 3
near = st.floats(0.0, 6.0).map(lambda offset: 300.0 + offset)
scores = st.none() | st.floats(0.0, 1.0)


@st.composite
def proposed(draw: st.DrawFn) -> LabelProposal:
    is_pole, side = draw(st.booleans()), draw(st.sampled_from(("left", "right")))
    u, v = draw(near), draw(near)
    end = (draw(near), v + draw(st.floats(1.0, 80.0))) if is_pole else None
    id_, class_id = f"{draw(st.integers(0, 99))}", POLE if is_pole else ROUND
    mark = Mark((u, v), end)
    return LabelProposal(id_, Pane(0, side), class_id, "map", "element", mark, draw(scores))


def by_pairs(proposals: list[LabelProposal]) -> list[LabelProposal]:
    """The definition, one pair after the other."""
    distinct: list[LabelProposal] = []
    for one in sorted(proposals, key=lambda each: -(each.score or 0.0)):
        is_duplicate = any(
            better.score is not None
            and one.score is not None
            and (better.pane, better.class_id) == (one.pane, one.class_id)
            and better.mark.gap_px(one.mark) < TAKEN_PX
            for better in distinct
        )
        distinct.append(replace(one, score=0.0) if is_duplicate else one)
    return distinct


@given(st.lists(proposed(), max_size=8))
def test_the_better_one_of_two_at_one_place_stays(proposals: list[LabelProposal]) -> None:
    assert select_distinct(proposals, Labels()) == by_pairs(proposals)

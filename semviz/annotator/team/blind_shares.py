"""Frames that two people label blind: which, how far both are, and how their labels agree.

Each of the two labels them in a file of their own, see ``semviz.workspace.blind``; the workspace's
own file takes no labels of these frames until they are merged. A frame that both have reviewed is
compared, and no longer changes in their files.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from semviz.workspace.blind import blind_workspace
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.agreement import (
    MATCH_PX,
    ElementPair,
    LabelAgreement,
    agreement_in,
    changed_in,
    pairs_in,
)
from semviz_annotation.labels.edits import SetAttribute
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import REVIEWED, Note
from semviz_annotation.storage.closed_frames import WhyClosed, is_untouched, why_until_merged
from semviz_annotation.storage.store import LabelStore
from semviz_annotation.storage.teamwork import BlindShare, share_text
from semviz_core.common.errors import SemvizError


def chosen_frames(candidates: Sequence[int], percent: float) -> tuple[int, ...]:
    """Return a share of frames, evenly spaced, at least one; the same each time."""
    count = min(len(candidates), max(1, round(len(candidates) * percent / 100.0)))
    return tuple(candidates[int((k + 0.5) * len(candidates) / count)] for k in range(count))


@dataclass(frozen=True)
class ShareProgress:
    """How far two people are with their frames."""

    share: BlindShare
    reviewed: tuple[int, int]
    """Frames that the first, and the second, has reviewed."""
    both: tuple[int, ...]
    """Frames that both have reviewed, merged or not."""
    merged: frozenset[int]


@dataclass(frozen=True)
class Compared:
    """Two versions of a frame."""

    people: tuple[str, str]
    """Who labelled them; empty if there is one version only."""
    times: tuple[str, str]
    """When; empty of frames labelled blind."""
    is_blind: bool
    pairs: tuple[ElementPair, ...]
    labels: tuple[Labels, Labels] | None = None
    """Of both people; None for versions of one file."""

    def differing(self, pair: ElementPair) -> str:
        """Return an attribute that both gave an element with two values; empty for none."""
        if self.labels is None or pair.first is None or pair.second is None:
            return ""
        ids = pair.first.id, pair.second.id
        mine, theirs = (
            {row.name: row.value for row in of.attributes_of(id_)}
            for of, id_ in zip(self.labels, ids, strict=True)
        )
        names = [name for name in mine if theirs.get(name, mine[name]) != mine[name]]
        return f"{names[0]}: {mine[names[0]]}, {theirs[names[0]]}" if names else ""


class BlindShares:
    """The shares of a workspace. Thread-safe."""

    def __init__(
        self, workspace: Workspace, store: Callable[[], LabelStore], order: Sequence[int]
    ) -> None:
        """``store`` returns the workspace's open label file; ``order`` are indices of frames."""
        self._workspace = workspace
        self._store = store
        self._order = tuple(order)
        self._readers: dict[str, LabelStore] = {}
        self._shares: Mapping[int, BlindShare] = {}
        self.follow()

    def follow(self) -> None:
        """Read the shares from the log again, and let the open label file follow them."""
        store = self._store()
        shares = store.team().shares
        for name in {name for share in shares for name in share.people} - {*self._readers}:
            self._readers[name] = blind_workspace(self._workspace, name).open_labels()
        self._shares = {frame: share for share in shares for frame in share.frames}
        store.closed = self._why_closed

    def close(self) -> None:
        for reader in self._readers.values():
            reader.close()

    @property
    def all(self) -> list[BlindShare]:
        return list({share.number: share for share in self._shares.values()}.values())

    def assign(
        self, frames: tuple[int, int], percent: float, people: tuple[str, str], author: str
    ) -> BlindShare:
        """Let two people label a share of a range of frames.

        Frames that have labels or a review, or are labelled twice already, are not chosen. Raise
        SemvizError if none is left, or the people are one.
        """
        first, second = people
        if first.casefold() == second.casefold():
            raise SemvizError("two different people label frames twice")
        if any(" | " in name for name in people):
            raise SemvizError("a name with ' | ' in it cannot be written down here")
        labels = self._store().labels
        free = [
            index
            for index in self._order
            if frames[0] <= index <= frames[1]
            and index not in self._shares
            and is_untouched(index, labels)
        ]
        if not free:
            raise SemvizError(f"no frame from {frames[0]} to {frames[1]} is without labels")
        for name in people:
            blind_workspace(self._workspace, name)  # before anything is written down
        chosen = chosen_frames(free, percent)
        operation = self._store().state("label twice", share_text(people, chosen), author)
        self.follow()
        return BlindShare(operation.number, people, chosen)

    def end(self, number: int, author: str) -> None:
        """End a share: its frames take labels again; what was labelled stays in both files."""
        if number not in {share.number for share in self.all}:
            raise SemvizError("these frames are not labelled twice any more")
        self._store().state("label once", str(number), author)
        self.follow()

    def of_person(self, name: str) -> list[BlindShare]:
        return [share for share in self.all if name in share.people]

    def progress(self, share: BlindShare) -> ShareProgress:
        """Return how far two people are."""
        first, second = (self.labels_of(name) for name in share.people)
        labels = self._store().labels
        reviewed = [[i for i in share.frames if _is_reviewed(i, of)] for of in (first, second)]
        return ShareProgress(
            share,
            (len(reviewed[0]), len(reviewed[1])),
            tuple(sorted({*reviewed[0]} & {*reviewed[1]})),
            frozenset(i for i in share.frames if not is_untouched(i, labels)),
        )

    def agreement(self, progress: ShareProgress) -> LabelAgreement:
        """Return how two people agree, in the frames that both have reviewed."""
        return agreement_in(progress.both, *map(self.labels_of, progress.share.people))

    def worst_px(self, share: BlindShare, frame_index: int) -> float:
        """Return how far two people's labels of a frame are apart, where they are farthest.

        An element that one alone labelled counts as ``MATCH_PX``: pairs are nearer.
        """
        pairs = pairs_in(frame_index, *map(self.labels_of, share.people))
        return max(
            (MATCH_PX if _wants_a_look(pair)[0] else pair.worst_px for pair in pairs), default=0.0
        )

    def compared(self, frame_index: int) -> Compared:
        """Return two versions of a frame, the elements that are farthest apart first.

        Raise SemvizError if it is labelled blind, and not reviewed by both.
        """
        store = self._store()
        labels, share = store.labels, self._shares.get(frame_index)
        if share is not None and is_untouched(frame_index, labels):
            if not self._both_reviewed(frame_index, share):
                raise SemvizError(_not_compared(frame_index, share))
            first, second = map(self.labels_of, share.people)
            pairs = pairs_in(frame_index, first, second)
            return Compared(share.people, ("", ""), True, _by_need(pairs), (first, second))
        earlier = store.earlier_version(frame_index)
        if earlier is None:
            return Compared(("", ""), ("", ""), False, ())
        writers = store.last_writers(row.id for row in labels.in_frame(frame_index))
        last = max(writers.values(), default=earlier)
        pairs = changed_in(frame_index, store.labels_at(earlier.number), labels)
        people, times = (earlier.author, last.author), (earlier.time, last.time)
        return Compared(people, times, False, _by_need(pairs))

    def beside(
        self, frame_index: int, elements: Mapping[str, str], of_second: frozenset[str]
    ) -> tuple[tuple[SetAttribute, ...], tuple[Note, ...]]:
        """Return what both wrote about elements that are merged: attributes, notes on this frame.

        ``elements`` are the ids that they get, by those of ``compared``. Where both have an
        attribute the first's counts, or the second's for elements of ``of_second``.
        """
        first, second = map(self.labels_of, self._shares[frame_index].people)
        attributes, notes = [], []
        for pair in pairs_in(frame_index, first, second):
            known = [
                (of, one.id) for of, one in ((first, pair.first), (second, pair.second)) if one
            ]
            id_ = elements.get(known[0][1])
            if id_ is None:
                continue
            ordered = known if known[0][1] in of_second else known[::-1]  # the last one counts
            values = {row.name: row.value for of, own in ordered for row in of.attributes_of(own)}
            attributes += [SetAttribute(id_, name, value) for name, value in values.items()]
            notes += [
                replace(note, element_id=id_)
                for of, own in known
                for note in of.notes_of(own)
                if note.frame_index == frame_index
            ]
        return tuple(attributes), tuple(notes)

    def labels_of(self, name: str) -> Labels:
        """Return what a person has labelled blind."""
        return self._readers[name].labels

    def why_closed_to(self, name: str) -> WhyClosed:
        """Return why frames of a person's own file take no edits."""

        def why_closed(frame_index: int, kind: str, labels: Labels) -> str:
            share = self._shares.get(frame_index)
            if share is None or name not in share.people:
                return f"frame {frame_index} is none of those that you label blind"
            (other,) = {*share.people} - {name}
            both = _is_reviewed(frame_index, labels)
            if both and _is_reviewed(frame_index, self.labels_of(other)):
                return f"both have reviewed frame {frame_index}; it is compared as it is"
            return ""

        return why_closed

    def _why_closed(self, frame_index: int, kind: str, labels: Labels) -> str:
        share = self._shares.get(frame_index)
        if kind != "merge frame":
            return why_until_merged(frame_index, share, labels)
        if share is None or not self._both_reviewed(frame_index, share):
            return _not_compared(frame_index, share)
        return ""

    def _both_reviewed(self, frame_index: int, share: BlindShare) -> bool:
        return all(_is_reviewed(frame_index, self.labels_of(name)) for name in share.people)


def _not_compared(frame_index: int, share: BlindShare | None) -> str:
    if share is None:
        return f"frame {frame_index} is not labelled twice"
    return f"{share.people[0]} and {share.people[1]} have not both reviewed frame {frame_index}"


def _is_reviewed(frame_index: int, labels: Labels) -> bool:
    return labels.review(frame_index) in REVIEWED


def _by_need(pairs: Iterable[ElementPair]) -> tuple[ElementPair, ...]:
    return tuple(sorted(pairs, key=_wants_a_look, reverse=True))


def _wants_a_look(pair: ElementPair) -> tuple[bool, bool, float]:
    alone = any(view.first is None or view.second is None for view in pair.views)
    alike = pair.same_class and all(view.same_ends for view in pair.views)
    return alone, not alike, pair.worst_px

"""Answers what offers ask of the images, and snaps what is drawn to them."""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from typing import Generic, TypeVar

from semviz.annotator.cameras import Cameras
from semviz.annotator.images import Images
from semviz.annotator.offers import Answer, FindPartner, Offer, Question, Settle
from semviz.annotator.panes import Pane
from semviz_annotation.assist.follow import follow
from semviz_annotation.assist.partner import find_partner
from semviz_annotation.assist.shot import Mark, Proposed, Shot
from semviz_annotation.assist.snap import Snapped, snap
from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError

KEPT_ANSWERS = 5000
KEPT_SHOTS = 12
"""About 23 MB of KITTI's."""

K = TypeVar("K")
V = TypeVar("V")


class Looker:
    """Looks at images and keeps what it saw. Thread-safe."""

    def __init__(self, images: Images, cameras: Cameras, classes: ClassSet) -> None:
        self._images = images
        self._cameras = cameras
        self._classes = classes
        self._answers: _Recent[Question, Answer] = _Recent(KEPT_ANSWERS)
        self._shots: _Recent[Pane, Shot] = _Recent(KEPT_SHOTS)

    def answered(self, offers: Iterable[Offer]) -> list[Offer]:
        """``offers`` as far as their questions have been answered; those of nothing left out."""
        known = [self._answered(one) for one in offers]
        return [one for one in known if one.mark is not None]

    def unanswered(self, offers: Iterable[Offer]) -> list[Question]:
        """What nobody has looked at yet."""
        questions = [one.question for one in offers if one.question is not None]
        return [one for one in questions if self._answers.get(one) is None]

    def answer(self, question: Question) -> None:
        """Takes some milliseconds. Where an image cannot be read nothing is found."""
        try:
            answer = self._look(question)
        except SemvizError:  # the page says so in the image's place
            answer = Answer(None)
        self._answers.put(question, answer)

    def snap(self, pane: Pane, mark: Mark, class_id: int) -> Snapped | None:
        """The edges that ``mark`` is meant to be on; None where nothing clear is there."""
        try:
            return snap(self._shot(pane), mark, self._classes[class_id])
        except SemvizError:
            return None

    def _answered(self, offer: Offer) -> Offer:
        answer = None if offer.question is None else self._answers.get(offer.question)
        return offer if answer is None else offer.answered(answer)

    def _look(self, question: Question) -> Answer:
        one = self._classes[question.class_id]
        there = self._shot(question.there)
        if isinstance(question, FindPartner):
            partners = find_partner(self._shot(question.here), there, question.mark, one)
            return Answer(None) if partners is None else Answer(partners.best, partners.runner_up)
        if isinstance(question, Settle):
            found = snap(there, question.mark, one)
            mark = question.mark if found is None else found.mark
            return Answer(Proposed(mark, question.score))
        seen = [(self._shot(pane), mark) for pane, mark in question.seen]
        return Answer(follow(seen, question.element, there, one))

    def _shot(self, pane: Pane) -> Shot:
        shot = self._shots.get(pane)
        if shot is None:
            pixels = self._images.pixels(pane.frame_index, pane.side)
            shot = Shot.of(self._cameras.view(pane.frame_index, pane.side), pixels)
            self._shots.put(pane, shot)
        return shot


class _Recent(Generic[K, V]):
    """The values of the last few keys."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._kept: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K) -> V | None:
        with self._lock:
            return self._kept.get(key)

    def put(self, key: K, value: V) -> None:
        with self._lock:
            self._kept[key] = value
            while len(self._kept) > self._limit:
                self._kept.popitem(last=False)

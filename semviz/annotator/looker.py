"""Answers what offers ask of the images, and snaps what is drawn to them."""

import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Generic, TypeVar

from semviz.annotator.cameras import Cameras
from semviz.annotator.images import Images
from semviz.annotator.offers import Answer, Follow, Offer, Question, Settle
from semviz.annotator.panes import Pane
from semviz_annotation.assist.follow import Sight, follow
from semviz_annotation.assist.partner import find_partner
from semviz_annotation.assist.settle import Found, settle
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
        self._answers: _Recent[Question, Mapping[Pane, Answer]] = _Recent(KEPT_ANSWERS)
        self._shots: _Recent[Pane, Shot] = _Recent(KEPT_SHOTS)

    def answered(self, offers: Iterable[Offer]) -> list[Offer]:
        """``offers`` as far as their questions have been answered; those of nothing left out."""
        known = [self._answered(one) for one in offers]
        return [one for one in known if one.mark is not None]

    def unanswered(self, offers: Iterable[Offer]) -> list[Question]:
        """What nobody has looked at yet."""
        questions = dict.fromkeys(one.question for one in offers if one.question is not None)
        return [one for one in questions if self._answers.get(one) is None]

    def answer(self, question: Question) -> None:
        """Takes some milliseconds. Where an image cannot be read nothing is found."""
        try:
            answers = self._look(question)
        except SemvizError:  # the page says so in the image's place
            answers = {}
        self._answers.put(question, answers)

    def found(self, question: Question, pane: Pane) -> Proposed | None:
        """What there is in an image; asks it if nobody has yet."""
        if self._answers.get(question) is None:
            self.answer(question)
        return (self._answers.get(question) or {}).get(pane, Answer(None)).best

    def snap(self, pane: Pane, mark: Mark, class_id: int) -> Snapped | None:
        """The edges that ``mark`` is meant to be on; None where nothing clear is there."""
        try:
            return snap(self._shot(pane), mark, self._classes[class_id])
        except SemvizError:
            return None

    def _answered(self, offer: Offer) -> Offer:
        answers = None if offer.question is None else self._answers.get(offer.question)
        return offer if answers is None else offer.answered(answers.get(offer.pane, Answer(None)))

    def _look(self, question: Question) -> dict[Pane, Answer]:
        """What was found, by image."""
        one = self._classes[question.class_id]
        if isinstance(question, Follow):
            sought = question.sought
            sights = [
                Sight(self._shot(each.there), self._shot(each.here), each.mark) for each in sought
            ]
            found = follow(sights, question.element, one)
            return {each.there: Answer(best) for each, best in zip(sought, found, strict=True)}
        if isinstance(question, Settle):
            return self._settled(question)
        there = self._shot(question.there)
        here = self._shot(question.here)
        partners = find_partner(here, there, question.mark, one, question.element)
        if partners is None:
            return {}
        return {question.there: Answer(partners.best, partners.runner_up)}

    def _settled(self, question: Settle) -> dict[Pane, Answer]:
        seen = [
            Found(self._shot(each.pane), each.mark, each.score, each.sigma_px, each.sigma_along_px)
            for each in question.found
        ]
        other = None if question.other is None else self._shot(question.other)
        panes = (*(each.pane for each in question.found), question.other)
        settled = settle(seen, other, self._classes[question.class_id])
        return {
            pane: Answer(each, depth_m=settled.depth_m)
            for pane, each in zip(panes, settled.proposed, strict=False)
            if pane
        }

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

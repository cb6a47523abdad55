"""Everything that is proposed for a frame: what geometry expects, as the images confirm it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from semviz.annotator.cameras import Cameras
from semviz.annotator.disagreement import Disagreement, disagreement, known_in, looked_at
from semviz.annotator.finds import Find, finds_in, offers_of
from semviz.annotator.ghosts import Ghost, ghosts_in
from semviz.annotator.looker import Looker
from semviz.annotator.nearby import Nearby, nearby_in
from semviz.annotator.offers import Expected, Offer, Question, offers_in
from semviz.annotator.panes import Pane, Panes
from semviz.annotator.places import Places
from semviz.annotator.refusals import Refusals
from semviz.annotator.rivals import checked
from semviz_annotation.labels import Labels
from semviz_annotation.proposals import Proposals

KEPT_FINDS = 256
"""Frames of which it is kept what a detector found in them."""


@dataclass(frozen=True)
class _Geometry:
    """What is proposed for a frame before anybody has looked at its images."""

    offers: tuple[Offer, ...]
    ghosts: tuple[Ghost, ...]
    """Mapped elements, where they should be."""
    nearby: tuple[Nearby, ...]


class Proposing:
    """Proposes observations for the images of a frame."""

    def __init__(
        self,
        cameras: Cameras,
        panes: Panes,
        places: Places,
        looker: Looker,
        detected: Proposals,
    ) -> None:
        self._cameras = cameras
        self._panes = panes
        self._places = places
        self._looker = looker
        self._order = tuple(cameras.T_map_camera)
        self._place_in_time = {index: place for place, index in enumerate(self._order)}
        self._detected = detected
        self._labels = Labels()
        self._known: dict[int, _Geometry] = {}
        """By frame, for these labels."""
        self._finds = lru_cache(KEPT_FINDS)(self._finds_in)
        self._refusals = Refusals(cameras, self._finds)

    def offers(self, frame_index: int, labels: Labels) -> list[Offer]:
        """What is proposed, as far as the images have been looked at."""
        offers = self._geometry(frame_index, labels).offers
        return checked(self._looker.answered(offers), labels)

    def unanswered(self, frame_index: int, labels: Labels) -> list[Question]:
        """What the images should be asked."""
        return self._looker.unanswered(self._geometry(frame_index, labels).offers)

    def nearby(self, frame_index: int, labels: Labels) -> tuple[Nearby, ...]:
        """Elements that are labelled around here, but have no place in space yet."""
        return self._geometry(frame_index, labels).nearby

    def survey(self, frame_index: int, labels: Labels) -> tuple[int, Disagreement | None]:
        """Elements that are proposed by geometry, and a detector's finds: how many; and where that
        detector and the labels disagree, None where none looked."""
        geometry = self._found(frame_index, labels)
        offers = [one for one in geometry.offers if not one.turned_down]
        count = len({one.element_id for one in offers if one.origin != "partner"})
        shown = [
            one for one in self._panes.of(frame_index).values() if one.frame_index == frame_index
        ]
        looked = looked_at(shown, self._detected)
        if not looked:
            return count, None
        known = known_in(looked, geometry.ghosts, labels, self._depth_m(frame_index, labels))
        return count, disagreement(looked, self._finds(frame_index), known, labels)

    def _depth_m(self, frame_index: int, labels: Labels) -> Callable[[str], float]:
        """How far ahead of a frame's left camera a mapped element is; 0 where nobody knows."""
        T_camera_map = self._cameras.T_camera_map(frame_index)
        near = self._places.near(labels, frame_index)

        def depth_m(element_id: str) -> float:
            place = near.get(element_id)
            if place is None or T_camera_map is None:
                return 0.0
            return float(T_camera_map.apply(place.anchor_m[None])[0, 2])

        return depth_m

    def ghosts(self, pane: Pane, labels: Labels) -> list[Ghost]:
        """Mapped elements that are expected in an image and not labelled there."""
        T_camera_map = self._cameras.T_camera_map(pane.frame_index)
        if T_camera_map is None:
            return []
        near = self._places.near(labels, pane.frame_index)
        return list(
            ghosts_in(pane.frame_index, pane.side, T_camera_map, self._cameras.rig, labels, near)
        )

    def _finds_in(self, frame_index: int) -> tuple[Find, ...]:
        return finds_in(self._panes.of(frame_index), self._detected, self._cameras)

    def _geometry(self, frame_index: int, labels: Labels) -> _Geometry:
        """As ``_found``, kept: it is asked for several times after each edit."""
        if labels is not self._labels:
            self._labels = labels
            self._known.clear()
        if frame_index not in self._known:
            self._known[frame_index] = self._found(frame_index, labels)
        return self._known[frame_index]

    def _found(self, frame_index: int, labels: Labels) -> _Geometry:
        panes = self._panes.of(frame_index)
        expected = [
            Expected(pane, ghost, self._places.near(labels, pane.frame_index)[ghost.element_id])
            for pane in panes.values()
            for ghost in self.ghosts(pane, labels)
        ]
        ghosts = tuple(one.ghost for one in expected)
        known = {one.element_id for one in ghosts}
        nearby = nearby_in(frame_index, self._order, known, labels, self._cameras, self._places)
        expected += [
            Expected(Pane(frame_index, ghost.side), ghost, None)
            for one in nearby
            for ghost in one.ghosts
        ]
        offers = offers_in(panes, expected, labels, self._place_in_time)
        finds = self._finds(frame_index)
        refused = self._refusals.again(frame_index, finds, labels)
        offers += offers_of(finds, panes, labels, refused)
        return _Geometry(tuple(offers), ghosts, nearby)

"""The tracks of a labelling session: rows for the page, one element, searches for it.

One thread at a time, except where a method says otherwise.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from semviz.annotator.panes import Cameras, Panes
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import ImageQuery
from semviz.annotator.proposals.proposal_selection import ProposalSelection
from semviz.annotator.tracks import track_details
from semviz.annotator.tracks.detection_tracks import OpenTracks
from semviz.annotator.tracks.track_rows import TrackFrame, TrackRow, TrackRows
from semviz_annotation.storage.store import LabelStore, Writer

AT_ONCE_S = 0.02
"""Rows that an edit changed are sent with it if they take no longer; the others follow."""


@dataclass(frozen=True, eq=False)
class SessionTracks:
    """The view "Tracks" of one label store."""

    store: LabelStore
    rows: TrackRows
    open_tracks: Callable[[], OpenTracks]
    selection: ProposalSelection
    panes: Panes
    cameras: Cameras
    worker: ImageWorker
    _collected: dict[str, TrackRow] = field(default_factory=dict)
    """Rows that have not been sent to the pages, by id; the newest of each."""

    def known(self) -> tuple[list[TrackRow], list[TrackFrame], int]:
        """Return the rows and frames known so far, and the number of all rows."""
        labels = self.store.labels
        rows, total = self.rows.known(labels, self.open_tracks())
        return rows, self.rows.frames(labels, self.rows.order), total

    def collect(self, seconds: float) -> bool:
        """Compute changed rows for that long; return whether there were any."""
        rows = self.rows.update(self.store.labels, self.open_tracks(), seconds)
        self._collected.update({row.id: row for row in rows})
        return bool(rows)

    def take_collected(self) -> list[TrackRow]:
        """Return the rows that were computed since the last call; send them to all pages."""
        rows = list(self._collected.values())
        self._collected.clear()
        return rows

    def changed(self) -> list[TrackRow]:
        """Return rows that are new or changed since the last call, for all pages."""
        self.collect(AT_ONCE_S)
        return self.take_collected()

    def frames(self, indices: list[int]) -> list[TrackFrame]:
        """Return what is expected in frames that were assessed."""
        return self.rows.frames(self.store.labels, indices) if self.rows.wanted else []

    def inspector(
        self, element_id: str
    ) -> tuple[track_details.TrackInspector, Mapping[str, Writer]]:
        """Return what describes an element, in any thread, and who placed its labels.

        Raise SemvizError if the element does not exist.
        """
        labels, end = self.store.labels_and_end
        labels.element(element_id)
        inspector = track_details.TrackInspector(
            cameras=self.cameras,
            positions=self.rows.positions,
            labels=labels,
            end=end,
            mapped=dict(self.rows.positions.mapped(labels)),
        )
        return inspector, self._placed(element_id)

    def open_track_views(self, track_id: str) -> list[track_details.TrackImage]:
        """Return the detections of an open track; none if it is no longer open."""
        tracks = self.open_tracks()
        for place, track in tracks.named([track_id], self.store.labels):
            element = tracks.tracks.elements[np.array([place])]
            return track_details.detection_views(track, element, self.cameras)
        return []

    def queries(self, element_id: str, index: int) -> list[ImageQuery]:
        """Return what to search the images of a frame for."""
        self.panes.show(index, None)
        return self.selection.queries_of(element_id, index, self.store.labels)

    def proposals(self, element_id: str, index: int) -> list[track_details.TrackProposal]:
        """Return the proposals of an element in a frame, as far as its images were searched."""
        self.panes.show(index, None)
        proposals = self.selection.proposals(index, self.store.labels)
        return track_details.track_proposals(proposals, element_id, index, self.cameras)

    def preview_resnap(self, element_id: str) -> track_details.ReSnapPreview:
        """Return what a re-snap would do; any thread. Raise SemvizError without the element."""
        labels = self.store.labels
        class_id = labels.element(element_id).class_id
        placed = self._placed(element_id)
        rows = labels.of_element(element_id)
        return track_details.preview_resnap(rows, class_id, placed, self.worker, self.cameras)

    def _placed(self, element_id: str) -> Mapping[str, Writer]:
        rows = self.store.labels.of_element(element_id)
        return self.store.placing_operations(row.id for row in rows)

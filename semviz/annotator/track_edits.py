"""Edits that accept or reject tracks of detections as a whole, in the labels of the moment."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, TypeAlias

from semviz.annotator import detection_tracks, messages
from semviz_annotation.labels.edits import AddElements, NewElement
from semviz_annotation.labels.labels import Labels, Observation, Pixel
from semviz_annotation.labels.rows import RowChange, Rules
from semviz_core.common.errors import SemvizError

Corrections: TypeAlias = Mapping[str, tuple[Pixel, Pixel | None]]
"""Ends by which a person replaced those of detections, by the detection's id."""


@dataclass(frozen=True, eq=False)
class TrackEdit:
    """Accept or reject tracks, all or none: new label elements with the free detections.

    Rejected ones are left out of maps. The tracks are chosen in the labels that the edit changes.
    """

    kind: Literal["accept tracks", "reject tracks"]
    choose: Callable[[Labels], Sequence[detection_tracks.DetectionTrack]]
    corrections: Corrections = field(default_factory=dict)

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        tracks = self.choose(labels)
        elements = tuple(
            NewElement(track.id, track.class_id, tuple(self._observations(track, labels)))
            for track in tracks
        )
        for track, element in zip(tracks, elements, strict=True):
            if not element.observations and track.id not in labels.elements:
                raise SemvizError(f"{track.name} is labelled in all images of the track already")
        return AddElements(elements, left_out=self.kind == "reject tracks").changes(labels, rules)

    def _observations(
        self, track: detection_tracks.DetectionTrack, labels: Labels
    ) -> Iterator[Observation]:
        for detection in detection_tracks.free_detections(track.detections, labels):
            row = detection_tracks.mark_of(detection).at(detection.frame_index, detection.side)
            row = replace(row, id=detection.id)
            if detection.id in self.corrections:
                anchor_px, end_px = self.corrections[detection.id]
                row = replace(row, anchor_px=anchor_px, end_px=end_px)
            yield row


def _named_tracks(
    tracks: detection_tracks.OpenTracks, track_ids: Iterable[str], labels: Labels
) -> Sequence[detection_tracks.DetectionTrack]:
    """Return tracks by their ids. Raise SemvizError if the map has none of an id."""
    by_id = tracks.tracks.by_id
    try:
        return [by_id[track_id] for track_id in dict.fromkeys(track_ids)]
    except KeyError:
        raise SemvizError("the last map has no such track any more; nothing was changed") from None


def _sure_tracks(
    tracks: detection_tracks.OpenTracks, count: int, labels: Labels
) -> Sequence[detection_tracks.DetectionTrack]:
    """Return all sure tracks. Raise SemvizError if their number is not ``count``, or is 0."""
    sure = tracks.sure(labels)
    if len(sure) != count or not count:
        raise SemvizError(
            f"{len(sure)} tracks are sure now, not {count}; nothing was changed"
            if sure
            else "no open track is sure; accept them one by one"
        )
    return sure


PageTrackEdit: TypeAlias = (
    messages.AcceptTracksEdit | messages.RejectTracksEdit | messages.AcceptSureTracksEdit
)


def track_edit(edit: PageTrackEdit, tracks: detection_tracks.OpenTracks) -> TrackEdit:
    """Return the edit of the labels that a page asks for."""
    match edit:
        case messages.AcceptSureTracksEdit():
            return TrackEdit("accept tracks", partial(_sure_tracks, tracks, edit.count))
        case messages.RejectTracksEdit():
            return TrackEdit("reject tracks", partial(_named_tracks, tracks, edit.track_ids))
        case messages.AcceptTracksEdit():
            corrections = {
                mark.observation_id: (mark.anchor_px, mark.end_px) for mark in edit.corrections
            }
            choose = partial(_named_tracks, tracks, edit.track_ids)
            return TrackEdit("accept tracks", choose, corrections)

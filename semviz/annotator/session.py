"""The labels of one workspace, edited by several people, without any web code.

An edit is on disk when its method returns. One thread at a time; the images, the image worker
and the map review may be used by any thread.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial

from semviz.annotator import messages, views
from semviz.annotator.drawing import draft
from semviz.annotator.drawing.accepted_marks import accepted, unlabelled
from semviz.annotator.drawing.association import (
    DraftAssociation,
    LabelBelow,
    SamePlaceError,
    SelectedElement,
    associate_draft,
    label_below,
)
from semviz.annotator.drawing.hidden_ends import HiddenEnds
from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.frame_quality import FrameQuality
from semviz.annotator.history import HistoryView, UpdateFeed
from semviz.annotator.map_review import MapWork, ReviewEntry, Reviews
from semviz.annotator.panes import Cameras, Panes, SecondImage
from semviz.annotator.proposals.image_worker import Images, ImageWorker
from semviz.annotator.proposals.label_proposals import ImageQuery, inside
from semviz.annotator.proposals.proposal_selection import ProposalSelection
from semviz.annotator.proposals.proposal_views import proposal_views
from semviz.annotator.scene_view import SceneElements
from semviz.annotator.session_results import BesideBlind, SavedEdit, Write
from semviz.annotator.team.team_view import TeamWork
from semviz.annotator.tracks import track_edits, track_messages
from semviz.annotator.tracks.detection_tracks import DetectionTracks
from semviz.annotator.tracks.session_tracks import SessionTracks
from semviz.annotator.tracks.track_rows import TrackRows
from semviz.web.protocol import RefusedError
from semviz.workspace.people import Role
from semviz.workspace.workspace import Workspace
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels import edits
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.proposals import load_proposals
from semviz_annotation.labels.views import camera_of
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_annotation.storage.label_file import Health
from semviz_annotation.storage.store import EditBase, Operation
from semviz_core.base.classes import ClassSet
from semviz_core.base.frame import Frame
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import cameras_by_frame


class LabelSession:
    """The labels of one workspace; see the module about threads."""

    def __init__(self, workspace: Workspace, author: str) -> None:
        self.workspace = workspace
        self.author = author
        self.source = workspace.source
        self.rig = self.source.rig
        self.frames: Mapping[int, Frame] = {frame.index: frame for frame in self.source.frames}
        if not self.frames:
            raise SemvizError(f"{workspace.path}: the sequence has no frames")
        self.choices = workspace.pose_choices()
        """What people chose for wrong poses when the session was opened."""
        self._store = workspace.open_labels()
        self._triangle_center = self._store.labels.triangle_center
        proposals = load_proposals(workspace.proposals_path, self.classes)
        detected = proposals.usable(self._triangle_center)
        self.left_out_proposals = len(proposals) - len(detected)
        """Triangular signs whose middle is of the other definition, and whose height is unknown."""
        self._store.check_in_background()
        self.images = Images(self.source)
        cameras = Cameras(self.rig, self.source.frames, cameras_by_frame(self.source))
        self._panes = Panes(cameras)
        self._positions = ElementPositions(cameras)
        self.image_worker = ImageWorker(
            self.images, cameras, lambda: self.classes, self._triangle_center
        )
        self._snap = lru_cache(maxsize=8)(self.image_worker.snap)  # the preview is what gets saved
        self._drafts = draft.DraftEditor(cameras, self._panes, self._positions)
        self._aligners = track_edits.Aligners(cameras, self._positions, self.image_worker)
        self.map_work = MapWork(
            workspace,
            lambda: self._store.labels,
            lambda semantic_map: DetectionTracks.of(semantic_map, detected, cameras),
        )
        self._reviews = Reviews(self.map_work)
        self._selection = ProposalSelection(
            cameras, self._panes, self._positions, self.image_worker, detected, self._reviews.tracks
        )
        self._hidden_ends = HiddenEnds(
            cameras, self._panes, self._positions, self.image_worker, self._selection
        )
        self._quality = FrameQuality(tuple(self.frames), self._positions, self._selection)
        self.history = HistoryView(self._store, self._panes, self.frames)
        self.tracks = SessionTracks(
            self._store,
            TrackRows(tuple(self.frames), self._positions, self._quality),
            self._reviews.tracks,
            self._selection,
            self._panes,
            cameras,
            self.image_worker,
        )
        self.team = TeamWork(self._store, self._quality, tuple(self.frames))
        self.beside_blind: BesideBlind = lambda frame_index, elements, of_second: ((), ())
        """Attributes and notes of elements that two people labelled blind."""
        self.scene = SceneElements(lambda: self.labels, self._positions, self._reviews.tracks)
        self._feed = UpdateFeed(self._store, self._quality)
        self._sent_map_version = self.map_work.version
        self._complete_version = self._sent_positions_version = self._positions.version
        """Versions of the positions when all were up to date, and when updates were sent last."""

    def close(self) -> None:
        self.map_work.close()
        self.images.close()
        self._store.close()

    @property
    def labels(self) -> Labels:
        return self._store.labels

    @property
    def classes(self) -> ClassSet:
        """The present classes: others may declare some meanwhile."""
        return self.labels.classes

    # -- reading

    def health(self) -> Health:
        """Return what is known about the label file; any thread may call it."""
        return self._store.health()

    def describe(self, author: str | None = None, role: Role = "review") -> views.WorkspaceView:
        """Return what seldom changes while the page of ``author`` is open."""
        return views.workspace_view(self.workspace, author or self.author, role, self.labels)

    def summary(self) -> views.LabelsView:
        """Return the state of the labels and all frames, without marks."""
        return self._view(self.labels, only_updates=False)

    def has_updates(self) -> bool:
        """Whether any process has changed labels or map since the last ``updates``, or all elements
        have been triangulated since."""
        map_changed = self.map_work.version != self._sent_map_version
        triangulated = self._complete_version > self._sent_positions_version
        return self._feed.has_updates or map_changed or triangulated

    def updates(self) -> views.LabelsView:
        """Return the summary, with only the frames changed since the last call; send it to all
        pages."""
        self._sent_map_version = self.map_work.version
        view = self._view(self.labels, only_updates=True)
        self._sent_positions_version = self._positions.version
        return view

    def analyze(self, seconds: float) -> bool:
        """Analyze tracks, elements, then frames, for that long; return whether that is all."""
        labels = self.labels
        if self.tracks.collect(seconds):  # somebody looks at them
            return False
        if not self._positions.update(labels, seconds):
            return False
        self._complete_version = self._positions.version
        return self._quality.update(labels, seconds)

    def take_assessed(self) -> list[views.FrameSummary]:
        """Return, as they are now, the frames that were assessed since the last call."""
        return self._summaries(self.labels, self._quality.take_assessed())

    def frame(self, index: int, second: SecondImage | None = None) -> draft.LabelledFrameView:
        """Return the labels and proposals of a frame, and the elements that may continue in it."""
        self._check_frame(index)
        self._panes.show(index, self._panes.chosen(index, second))
        labels, end = self._store.labels_and_end
        panes = self._panes.of(index)
        proposals = self._hidden_ends.with_hidden_ends(
            self._selection.proposals(index, labels), index, labels
        )
        nearby = self._selection.nearby(index, labels)
        return draft.LabelledFrameView(
            index=index,
            operation=end.number,
            hash=end.hash,
            panes=views.pane_views(self._panes, index),
            at_that_time=self._panes.at_that_time(index),
            elements=views.element_views(labels, panes, self.classes),
            proposals=proposal_views(proposals, panes, labels, self.rig, self.classes),
            nearby=views.nearby_views(nearby, labels, self.classes),
            is_searching=bool(self._selection.pending_queries(index, labels)),
        )

    def is_near(self, index: int, changed: Sequence[int]) -> bool:
        """Return whether changes of these frames may show in a frame; so may those of none."""
        return not changed or self._quality.is_near(index, changed)

    def review(self, request: messages.ShowReviewRequest) -> ReviewEntry:
        """Return a decision of the last map, or a finding in it; see ``Reviews.entry``."""
        return self._reviews.entry(
            request.list_name, request.key, request.place, request.by, self.labels
        )

    def pending_queries(self, index: int, second: SecondImage | None = None) -> list[ImageQuery]:
        """Return the queries for ``image_worker`` that complete the proposals of a frame."""
        self._panes.show(index, self._panes.chosen(index, second))
        return self._selection.pending_queries(index, self.labels)

    def position(self, element_id: str) -> Triangulated | None:
        """Return the position of an element in the map frame; None if it is unknown."""
        found = self._positions.of_element(self.labels, element_id)
        return found if isinstance(found, Triangulated) else None

    # -- editing

    def apply(
        self,
        request_id: str,
        edit: messages.PageEdit,
        base: EditBase | None = None,
        author: str | None = None,
    ) -> SavedEdit:
        """Apply an edit of ``author``; it is on disk on return. ``base``: what the page had shown.

        A request that is sent twice is applied once. Raise SemvizError if the edit is invalid,
        ConflictError if it overwrites what the page had not shown, and LabelFileError if it cannot
        be written.
        """
        self._store.check_triangles(self._triangle_center)
        author = author or self.author
        write = partial(self._store.apply, author=author, request_id=request_id, base=base)
        match edit:
            case messages.UndoEdit():
                of = edit.request and self._store.number_of(edit.request)
                return self._saved(self._store.undo(author, request_id, of or None, base))
            case messages.RedoEdit():
                return self._saved(self._store.redo(author, request_id, base))
            case messages.DrawEdit():
                return self._draw(edit, write)
            case messages.NameEdit():
                return self._saved(self._store.name_state(edit.name, author, request_id))
            case messages.RestoreEdit():
                return self._saved(self._store.restore(edit.number, author, request_id, base))
            case track_messages.NoteEdit():
                return self._saved(write(edit.note(author)))
            case messages.AcceptEdit():
                marks, note = unlabelled(edit.marks, self.labels)
                return replace(self._saved(write(edits.AddMany(self._accepted(marks)))), note=note)
            case messages.MergeFrameEdit():
                return self._saved(write(self._merged(edit)))
            case (
                track_edits.AcceptTracksEdit()
                | track_edits.RejectTracksEdit()
                | track_edits.AcceptSureTracksEdit()
            ):
                return self._decide_tracks(edit, write)
            case track_edits.AlignLabelsEdit():
                aligned = self._aligners.of(edit, self.labels, self._panes).edit()
                return replace(self._saved(write(aligned)), note=aligned.note)
            case _:
                return self._saved(write(edit))

    def queries_of(self, edit: messages.PageEdit) -> list[ImageQuery]:
        """Return the queries that an edit needs: processed before, they hold nobody up."""
        return self._aligners.queries(edit, self.labels, self._panes)

    def _draw(self, edit: messages.DrawEdit, write: Write) -> SavedEdit:
        """Add an observation, of the element it belongs to or of a new one."""
        selected = SelectedElement.of(edit.selected_id, edit.is_chosen)
        addition, note = self._addition(edit, selected, edit.snap, edit.asks_bottom)
        is_resent = edit.observation_id in self.labels.observations
        if edit.asks_same and edit.class_id is not None and not is_resent:
            known = addition.anchor_known, addition.end_known
            mark = Mark(addition.anchor_px, addition.end_px, *known)
            drawn = mark.at(addition.frame_index, addition.side)
            if below := self._below(drawn, edit.class_id):
                raise SamePlaceError(drawn, below)
        return replace(self._saved(write(addition)), note=note)

    def _accepted(self, marks: Iterable[messages.DrawnMark]) -> tuple[edits.AddObservation, ...]:
        return accepted(marks, self.labels, lambda mark: self._addition(mark)[0])

    def _merged(self, edit: messages.MergeFrameEdit) -> edits.MergeFrame:
        """Return the edit that takes labels of two people, with what is beside them."""
        added = self._accepted(edit.marks)
        joins = {
            mark.element_id: row.element_id
            for mark in edit.marks
            for row in added
            if row.observation_id == mark.observation_id
        }
        beside = self.beside_blind(edit.frame_index, joins, frozenset(edit.of_second))
        return edits.MergeFrame(edit.frame_index, added, *beside)

    def _decide_tracks(self, edit: track_edits.PageTrackEdit, write: Write) -> SavedEdit:
        """Accept or reject tracks of the last map, all or none."""
        self.map_work.wait_for_first()
        decision = track_edits.track_edit(edit, self._reviews.tracks())
        return self._saved(write(decision))

    def _addition(
        self,
        mark: messages.DrawnMark,
        selected: SelectedElement | None = None,
        snap: bool = False,
        asks_bottom: bool = False,
    ) -> tuple[edits.AddObservation, str]:
        """Return the edit that adds a mark, and a message for the user.

        Without ``class_id`` the mark belongs to ``element_id``. With one it belongs to
        ``selected``, to an element expected there, or to a new ``element_id``.
        """
        self._check_frame(mark.frame_index)
        self._panes.show(mark.frame_index, mark.second)
        pane = self._panes.pane(mark.frame_index, mark.side)
        addition = edits.AddObservation(
            observation_id=mark.observation_id,
            element_id=mark.element_id,
            frame_index=pane.frame_index,
            side=pane.side,
            anchor_px=mark.anchor_px,
            end_px=mark.end_px,
            anchor_known=mark.anchor_known,
            end_known=mark.end_known,
            class_id=mark.class_id,
        )
        if mark.class_id is None:
            return addition, ""
        drawn = mark.draft(mark.class_id, snap, asks_bottom)
        drawing = self._snapped(drawn, mark.frame_index, selected)
        association = self._associate(mark.frame_index, drawing, selected)
        addition = replace(
            addition,
            anchor_px=drawing.anchor_px,
            end_px=drawing.end_px,
            anchor_known=drawing.anchor_known,
            end_known=drawing.end_known,
        )
        if association.element_id is not None:
            addition = replace(addition, element_id=association.element_id, class_id=None)
        return addition, association.note

    def _saved(self, operation: Operation) -> SavedEdit:
        return SavedEdit.of(operation, self.labels, self.frames)

    # -- drafts

    def preview(self, state: draft.DraftState) -> draft.DraftPreview:
        """Return guides in both images, the element that a drawing joins, and its card."""
        self._check_frame(state.frame_index)
        self._panes.show(state.frame_index, state.second)
        labels = self.labels
        association, snapped, below = DraftAssociation(state.selected_id), None, None
        selected = SelectedElement.of(state.selected_id, state.is_chosen)
        if state.drawing is not None:
            drawing = self._snapped(state.drawing, state.frame_index, selected)
            if drawing is not state.drawing:
                snapped = draft.snapped_view(state.drawing, drawing)
            state = replace(state, drawing=drawing)
            if drawing.has_shape:
                association = self._associate(state.frame_index, drawing, selected)
                observation = self._drafts.observation(drawing, state.frame_index)
                below = self._below(observation, drawing.class_id)
        element = labels.elements.get(association.element_id or "")
        name = None if element is None else views.label_element_name(element, self.classes)
        guides, card = self._drafts.describe(state, association.element_id, labels)
        joins = name if state.drawing is not None else None
        warning = below.text if below else association.off
        return draft.DraftPreview(
            guides=guides, card=card, snapped=snapped, joins=joins, warning=warning
        )

    def _below(self, drawn: Observation, class_id: int) -> LabelBelow | None:
        return label_below(drawn, self.classes[class_id].kind == "line", self.labels)

    def _snapped(
        self, drawing: draft.ElementDraft, frame_index: int, selected: SelectedElement | None
    ) -> draft.ElementDraft:
        """Snap a drawing to clear edges, and mark its bottom as hidden if the ground is clearly
        below; each only if the drawing asks for it."""
        finds = drawing.snap or drawing.whole
        moved = self._on_edges(drawing, frame_index) if finds else drawing
        if not (moved.asks_bottom and moved.end_known and moved.end_px and moved.has_shape):
            return moved
        selected_id = None if selected is None else selected.id
        hidden = self._hidden_ends.is_hidden(moved, frame_index, selected_id, self.labels)
        return replace(moved, end_known=False) if hidden else moved

    def _on_edges(self, drawing: draft.ElementDraft, frame_index: int) -> draft.ElementDraft:
        pane = self._panes.pane(frame_index, drawing.side)
        camera, _ = camera_of(self.rig, pane.side)
        if not camera.contains(drawing.mark.ends_px).any():
            return drawing  # there are no edges outside
        if drawing.whole:
            mark = self.image_worker.whole_pole(pane, drawing.anchor_px, drawing.class_id)
        else:
            snapped = self._snap(pane, drawing.mark, drawing.class_id)
            mark = None if snapped is None else inside(snapped.mark, camera)
        return drawing if mark is None else drawing.moved_to(mark)

    def _associate(
        self, frame_index: int, drawing: draft.ElementDraft, selected: SelectedElement | None
    ) -> DraftAssociation:
        labels = self.labels
        observation = self._drafts.observation(drawing, frame_index)
        pane = self._panes.pane(frame_index, drawing.side)
        proposals = self._selection.proposals(frame_index, labels)
        here = [proposal for proposal in proposals if proposal.pane == pane]
        return associate_draft(
            observation, drawing.class_id, selected, here, labels, self._positions
        )

    def _view(self, labels: Labels, only_updates: bool) -> views.LabelsView:
        """The summary with all frames, or with those that changed since the last update."""
        history = self._feed.history(labels)
        frames: Iterable[int] = self.frames
        if only_updates:
            frames = sorted(self._feed.take_changed_frames() & self.frames.keys())
        return views.LabelsView(
            operation=self._feed.end.number,
            hash=self._feed.end.hash,
            counts=views.class_counts(labels),
            mapped=len(self.scene.elements()),
            can_undo=self.history.can_undo(self.author, self.choices),
            can_redo=self.history.can_redo(self.author),
            history=history,
            map=self._reviews.summary(labels),
            frames=self._summaries(labels, frames),
            team=self._feed.team,
        )

    def _summaries(self, labels: Labels, indices: Iterable[int]) -> list[views.FrameSummary]:
        return views.frame_summaries(labels, indices, self._quality.of, self.workspace)

    def _check_frame(self, index: int) -> None:
        if index not in self.frames:
            raise RefusedError("not_found", f"frame {index} is not in this sequence")
        self._store.check_triangles(self._triangle_center)

"""Read, lint and rebuild the maps of a workspace; list open tracks, decisions and findings.

A map is worked on in a thread of its own and replaced as a whole, so any thread may read it.
Decisions and findings are listed as open while labels change; an edit affects few of thousands.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz.annotator.tracks.detection_tracks import DetectionTrack, DetectionTracks, OpenTracks
from semviz.web.protocol import Part, RefusedError
from semviz.workspace.maps.map_review import (
    EntryElement,
    EntryView,
    FigureView,
    entry_key,
    entry_view,
)
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.decisions import is_open
from semviz_annotation.mapping.quality.lint_context import Finding
from semviz_core.base.semantic_map import Decision, SemanticMap
from semviz_core.common.errors import SemvizError

FROM_DETECTIONS = "from-detections"
"""Default name of a map from detections."""
Stamp: TypeAlias = tuple[int, int]
"""Time (ns) and size of a file, which differ between two versions of it."""


@dataclass(frozen=True, eq=False)
class LintedMap:
    """A map with its lint findings."""

    semantic_map: SemanticMap
    findings: tuple[Finding, ...]
    """Most severe first."""


class MapWork:
    """Reads and builds maps in a thread of its own. Any thread may read the results: they are
    replaced whole.

    Decisions and findings are those of the map ``main``, tracks those of the newest map from
    detections: ``main`` or ``from-detections``.
    """

    def __init__(
        self,
        workspace: Workspace,
        labels: Callable[[], Labels],
        find_tracks: Callable[[SemanticMap], DetectionTracks],
    ) -> None:
        """``find_tracks`` returns the tracks of detections in a map."""
        self._workspace = workspace
        self._labels = labels
        self._find_tracks = find_tracks
        self._reading: Future[None] | None = None
        self._was_read = False
        self._pool = ThreadPoolExecutor(1, "semviz-map")
        self._stamps: Mapping[str, Stamp] = {}
        """Of the map files that exist, when they were read."""
        self._stopping = False
        self.built: LintedMap | None = None
        """None if there is no map yet, or it has not been read."""
        self.tracks = DetectionTracks()
        """Empty if there is no map from detections, or it has not been read."""
        self.failure = ""
        """Why the last map could not be read or built."""
        self.building: str | None = None
        """The current stage of a build; None while no map is being built."""
        self.version = 0
        """Changes whenever one of these changes."""

    def refresh(self) -> None:
        """Read the map files in the background if one has changed."""
        before, self._stamps = self._stamps, self._present()
        if before != self._stamps:
            changed = before.get(MAIN) != self._stamps.get(MAIN)
            self._reading = self._pool.submit(self._work, partial(self._read, changed))

    def wait_for_first(self) -> None:
        """Wait until the maps that were there at the start have been read: edits may name their
        tracks."""
        if self._reading is not None and not self._was_read:
            self._reading.result()

    def _present(self) -> Mapping[str, "Stamp"]:
        stamps = {name: _stamp(self._workspace.map_path(name)) for name in (MAIN, FROM_DETECTIONS)}
        return {name: stamp for name, stamp in stamps.items() if stamp is not None}

    def build(self) -> None:
        """Build the map in the background. Raise RefusedError if a build is running."""
        if self.building is not None:
            raise RefusedError("busy", "the map is being built already")
        self.building, self._stopping = "starting", False
        self.version += 1
        self._pool.submit(self._work, self._build)

    def stop(self) -> None:
        """Cancel the build soon; the present map stays."""
        self._stopping = True

    def close(self) -> None:
        """Cancel a build and wait for the thread."""
        self.stop()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _work(self, do: Callable[[], None]) -> None:
        try:
            self.failure = ""
            do()
        except SemvizError as error:
            self.failure = str(error)
        except Exception as error:  # nothing else reports errors of this thread
            self.failure = f"the map: {error!r}; please report this"
        finally:
            self.version += 1

    def _read(self, main_changed: bool) -> None:
        try:
            if MAIN not in self._stamps:
                self.built = None
            elif main_changed:
                self._lint(self._workspace.read_map(MAIN))
            self._find()
        finally:
            self._was_read = True

    def _find(self) -> None:
        """Find the tracks of the newest map from detections."""
        from semviz_annotation.mapping.build import uses_detections

        for name in sorted(self._stamps, key=lambda name: self._stamps[name], reverse=True):
            if name == MAIN and self.built is not None:
                semantic_map = self.built.semantic_map
            else:
                semantic_map = self._workspace.read_map(name)
            if uses_detections(semantic_map):
                self.tracks = self._find_tracks(semantic_map)
                return
        self.tracks = DetectionTracks()

    def _build(self) -> None:
        """Build the map of the labels, and that from detections if there is one.

        Without labels there is only the latter.
        """
        from semviz_annotation.mapping.build import uses_detections

        try:
            labels = self._labels()
            main = None if self.built is None else self.built.semantic_map
            has_other = FROM_DETECTIONS in self._stamps
            if main is not None and uses_detections(main):
                self._lint(self._saved(MAIN, self._rebuilt(main, labels)))
            elif labels.without_left_out().observations or not has_other:
                self._lint(self._saved(MAIN, self._of_labels(labels)))
            if has_other:
                old = self._workspace.read_map(FROM_DETECTIONS)
                self._saved(FROM_DETECTIONS, self._rebuilt(old, labels))
            self._stamps = self._present()
            self._find()
        finally:
            self.building = None

    def _of_labels(self, labels: Labels) -> SemanticMap:
        from semviz.workspace.poses.pose_review import pose_errors
        from semviz_annotation.mapping.build import build_map

        workspace = self._workspace
        built, _ = build_map(
            labels,
            workspace.source,
            on_progress=self._on_progress,
            poses=pose_errors(workspace),
        )
        return built

    def _rebuilt(self, old: SemanticMap, labels: Labels) -> SemanticMap:
        from semviz.workspace.observations import read_detections
        from semviz.workspace.poses.pose_review import pose_errors
        from semviz_annotation.mapping.build import rebuild_map

        detections = read_detections(self._workspace, ())
        source, poses = self._workspace.source, pose_errors(self._workspace)
        built, _ = rebuild_map(old, labels, source, self._on_progress, detections, poses)
        return built

    def _saved(self, name: str, semantic_map: SemanticMap) -> SemanticMap:
        from semviz.workspace.poses.pose_review import with_used_poses
        from semviz_core.base.map_file import save_map

        semantic_map = with_used_poses(semantic_map, self._workspace)
        save_map(semantic_map, self._workspace.map_path(name))
        return semantic_map

    def _on_progress(self, stage: str, done: int, total: int) -> None:
        if self._stopping:
            raise SemvizError("Stopped: the map is as it was.")
        self.building = f"{stage}, {100 * done // max(total, 1)} %"
        self.version += 1

    def _lint(self, semantic_map: SemanticMap) -> None:
        from semviz_annotation.mapping.quality.lint import lint

        findings = lint(semantic_map, self._labels(), self._workspace.source)
        self.built = LintedMap(semantic_map, findings)


def _stamp(path: Path) -> Stamp | None:
    """The stamp of a file; None if there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


SHOWN_FRAMES = 4
"""Number of frames listed for a track."""
ReviewList: TypeAlias = Literal["tracks", "decisions", "findings"]


class MapSummary(Part):
    """The last map, and the number of open decisions and findings."""

    built: int | None
    """Number of the last operation it contains; None if there is no map."""
    elements: int
    tracks: int
    """Number of open tracks of detections."""
    sure_tracks: int
    """Number of those that one operation may accept together."""
    decisions: int
    findings: int
    building: str | None
    """The current stage of a build; None while no map is being built."""
    failure: str


class ReviewEntry(Part):
    """One entry of a list; ``entry`` is None if the list is empty."""

    list_name: ReviewList
    count: int
    place: int = 0
    entry: EntryView | None = None


class Reviews:
    """Open decisions and findings of the last map. One thread at a time."""

    def __init__(self, work: MapWork) -> None:
        self._work = work
        self._built: LintedMap | None = None
        self._open = OpenDecisions(())
        """Of that map."""
        self._tracks = OpenTracks(work.tracks)

    def summary(self, labels: Labels) -> MapSummary:
        """Return the state of the last map and of a running build."""
        built = self._work.built
        tracks = self.tracks()
        return MapSummary(
            built=None if built is None else built.semantic_map.operation,
            elements=0 if built is None else len(built.semantic_map),
            tracks=len(tracks.places(labels)),
            sure_tracks=len(tracks.sure(labels)),
            decisions=len(self._decisions(built, labels)),
            findings=0 if built is None else len(built.findings),
            building=self._work.building,
            failure=self._work.failure,
        )

    def entry(
        self, name: ReviewList, key: str | None, place: int, by: Literal[-1, 0, 1], labels: Labels
    ) -> ReviewEntry:
        """Return the entry ``by`` places after the one with ``key``.

        If that entry has been decided, the one that followed it is at ``place`` now.
        """
        built = self._work.built
        entries: Sequence[Decision | Finding | DetectionTrack]
        if name == "tracks":
            entries = self.tracks().of(labels)
        elif name == "findings":
            entries = () if built is None else built.findings
        else:
            entries = self._decisions(built, labels)
        if not entries:
            return ReviewEntry(list_name=name, count=0)
        keys = [_key(entry) for entry in entries]
        index = keys.index(key) + by if key in keys else place + min(by, 0)
        index = min(max(index, 0), len(entries) - 1)
        entry = entries[index]
        if isinstance(entry, DetectionTrack):
            view = _track_entry(entry)
        else:
            assert built is not None
            view = entry_view(entry, built.semantic_map, labels)
        return ReviewEntry(list_name=name, count=len(entries), place=index, entry=view)

    def tracks(self) -> OpenTracks:
        """Return the tracks of the last map; the same object until the map changes."""
        if self._work.tracks is not self._tracks.tracks:
            self._tracks = OpenTracks(self._work.tracks)
        return self._tracks

    def _decisions(self, built: LintedMap | None, labels: Labels) -> tuple[Decision, ...]:
        if built is not self._built:
            self._built = built
            self._open = OpenDecisions(() if built is None else built.semantic_map.decisions)
        return self._open.of(labels)


def _key(entry: Decision | Finding | DetectionTrack) -> str:
    return entry.id if isinstance(entry, DetectionTrack) else entry_key(entry)


def _track_entry(track: DetectionTrack) -> EntryView:
    """The view of an open track, with some of its frames."""
    frames = track.frames
    some = np.linspace(0, len(frames) - 1, min(len(frames), SHOWN_FRAMES)).round().astype(int)
    element = EntryElement(
        id=track.id,
        number=track.map_id,
        name=track.name,
        class_id=track.class_id,
        map_id=track.map_id,
        frames=[frames[place] for place in some],
    )
    images = len(track.detections)
    found = f"{images} detections that fit one object" if images > 1 else "A single detection"
    return EntryView(
        key=track.id,
        kind="track",
        reason=f"{found}: {track.doubt}, look at it first" if track.doubt else f"{found}: sure",
        evidence=[
            FigureView(name="Frames", value=f"{len(frames)}"),
            FigureView(name="Residual", value=f"{track.residual_px:.1f} px"),
            FigureView(name="Existence", value=track.existence),
        ],
        elements=[element],
        about=[],
        answers=[],
        frame=track.best_frame,
    )


class OpenDecisions:
    """Tracks which decisions are open while labels change: an edit affects few of thousands."""

    def __init__(self, decisions: Sequence[Decision]) -> None:
        self._decisions = decisions
        self._about: dict[str, list[int]] = {}
        """Indices of the decisions about each label element."""
        for index, decision in enumerate(decisions):
            for element_id in decision.label_ids:
                self._about.setdefault(element_id, []).append(index)
        self._labels = Labels()
        self._open: set[int] = set()

    def of(self, labels: Labels) -> tuple[Decision, ...]:
        """Return the open decisions in their order."""
        for element_id in labels.differing(self._labels):
            for index in self._about.get(element_id, ()):
                if is_open(self._decisions[index], labels):
                    self._open.add(index)
                else:
                    self._open.discard(index)
        self._labels = labels
        return tuple(self._decisions[index] for index in sorted(self._open))

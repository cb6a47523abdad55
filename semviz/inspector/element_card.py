"""The card of one map element: its accuracy, its use in the run, and its labels.

An open label file is kept, so that only new operations are read.
"""

import weakref
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from semviz.inspector import views_frame
from semviz.runs.frame_table import frame_table
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import RefusedError
from semviz.workspace.settings import SETTINGS
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import load_proposals
from semviz_annotation.mapping.build import uses_detections
from semviz_annotation.storage.store import LabelStore, LogEnd, Writer
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, Provenance, SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True)
class Origin:
    """A label element behind a map element, in its present state."""

    element: LabelElement
    used: tuple[Observation, ...]
    """Observations that the map element was built from, by frame, left first."""
    others: int
    """Number of its other observations: excluded, of another landmark, or newer than the map."""
    writer: Writer | None
    """The last operation on any of ``used``."""


class Origins:
    """The labels behind the elements of one run's map."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is the file of the run."""
        self._run = run
        self._path = path

    def of(self, element_id: int) -> tuple[Origin, ...]:
        """Return the label elements behind a map element, by number.

        If there are none, ``why_none`` gives the reason. Raise SemvizError if the label file
        cannot be read.
        """
        provenance = provenance_of(self._run.semantic_map, element_id)
        if self._store is None or provenance is None:
            return ()
        labels = self._store.labels
        sources = [labels.elements[id_] for id_ in provenance.label_ids if id_ in labels.elements]
        used = frozenset(provenance.observation_ids)
        return tuple(
            self._origin(element, used, labels)
            for element in sorted(sources, key=lambda element: element.number)
        )

    def track(self, element_id: int) -> tuple[Proposal, ...]:
        """Return the detections that a map element was built from; empty if it has labels, or if
        the detections were replaced since."""
        provenance = provenance_of(self._run.semantic_map, element_id)
        if provenance is None or self.of(element_id):
            return ()
        rows = (self._detections.get(id_) for id_ in provenance.observation_ids)
        return tuple(row for row in rows if row is not None)

    def why_none(self, element_id: int) -> str:
        """Return the reason why ``of`` finds no labels; empty if it finds some."""
        provenance = provenance_of(self._run.semantic_map, element_id)
        if provenance is None:
            return "The map does not name the labels that it was built from."
        if self._store is None:
            workspace = self._run.info.workspace or "the run names no workspace"
            return f"The labels were not found ({workspace})."
        if track := self.track(element_id):
            frames = sorted({row.frame_index for row in track})
            return (
                f"A track of {len(track)} detections in {len(frames)} frames, {frames[0]} to "
                f"{frames[-1]}, which nobody has accepted."
            )
        if not self.of(element_id):
            return "Its labels were deleted after this map was built."
        return ""

    def _origin(self, element: LabelElement, used: frozenset[str], labels: Labels) -> Origin:
        rows = labels.of_element(element.id)
        own = tuple(row for row in rows if row.id in used)
        assert self._store is not None
        writers = self._store.last_writers(row.id for row in own).values()
        last = max(writers, key=lambda writer: writer.number, default=None)
        return Origin(element, own, len(rows) - len(own), last)

    @cached_property
    def workspace(self) -> Workspace | None:
        """The workspace with the labels; None if it is not found."""
        return workspace_of(self._run, self._path)

    @property
    def end(self) -> LogEnd | None:
        """The last operation on the labels; None if they are not found."""
        return None if self._store is None else self._store.end

    def holds(self, end: LogEnd) -> bool:
        """Whether ``end`` is an operation on these labels: not if a backup has replaced them."""
        return self._store is not None and self._store.holds(end)

    @cached_property
    def _detections(self) -> dict[str, Proposal]:
        """The workspace's detections by id, if the map was built from detections."""
        if self.workspace is None or not uses_detections(self._run.semantic_map):
            return {}
        path, classes = self.workspace.proposals_path, self.workspace.classes
        return {row.id: row for row in load_proposals(path, classes).rows()}

    @cached_property
    def _store(self) -> LabelStore | None:
        if self.workspace is None:
            return None
        store = LabelStore.open(self.workspace.labels_path)
        weakref.finalize(self, store.close)
        return store


def provenance_of(semantic_map: SemanticMap, element_id: int) -> Provenance | None:
    """Return None if the map lacks the element, or was not built from labels."""
    row = map_row(semantic_map, element_id)
    return None if row is None or not semantic_map.provenance else semantic_map.provenance[row]


def map_row(semantic_map: SemanticMap, element_id: int) -> int | None:
    """Return the row of an element in the map; None if the map lacks it."""
    ids, order = semantic_map.elements.id, _by_id(semantic_map)
    index = np.searchsorted(ids, element_id, sorter=order)
    is_mapped = index < len(ids) and ids[order[index]] == element_id
    return int(order[index]) if is_mapped else None


@lru_cache(maxsize=4)
def _by_id(semantic_map: SemanticMap) -> IntArray:
    order: IntArray = np.argsort(semantic_map.elements.id)
    return order


def workspace_of(run: Run, path: Path) -> Workspace | None:
    """Return the workspace that holds the run's file, or else the one that the run names.

    None if neither holds the labels or detections that the run's map was built from.
    """
    semantic_map = run.semantic_map
    detected = {id_ for row in semantic_map.provenance for id_ in row.observation_ids}
    ids = {id_ for row in semantic_map.provenance for id_ in row.label_ids}
    ids |= {id_ for decision in semantic_map.decisions for id_ in decision.label_ids}
    for workspace in workspaces_near(run, path):
        if ids & workspace.read_labels().elements.keys():
            return workspace
        if uses_detections(semantic_map) and detected & set(
            load_proposals(workspace.proposals_path, workspace.classes).id
        ):
            return workspace
    return None


def workspaces_near(run: Run, path: Path) -> Iterator[Workspace]:
    """Yield the workspace that holds the run's file, and the one that the run names, if any."""
    named = [Path(run.info.workspace)] if run.info.workspace else []
    for folder in (path.resolve().parent.parent, *named):
        if (folder / SETTINGS).is_file():
            yield Workspace.open(folder)


def element_card(run: Run, record: FrameRecord, element_id: int) -> views_frame.ElementCard:
    """Return the card of a map element, from the camera of one frame."""
    provenance = provenance_of(run.semantic_map, element_id)
    return views_frame.ElementCard(
        name=run.semantic_map.name_of(element_id),
        class_id=int(mapped(run, element_id).class_id[0]),
        place=_place(mapped(run, element_id), _eye_m(record)),
        meaning=_meaning(run, element_id),
        existence=provenance.existence if provenance else "",
        in_run=_in_run(run, element_id),
        decisions=_decisions(run, element_id),
    )


def mapped(run: Run, element_id: int) -> Elements3D:
    """Return one element of the run's map. Raise RefusedError if the map lacks it."""
    row = map_row(run.semantic_map, element_id)
    if row is None:
        text = f"the map of this run has no element {element_id}; reload the page"
        raise RefusedError("not_found", text)
    return run.semantic_map.elements[[row]]


def _eye_m(record: FrameRecord) -> FloatArray:
    """Return (3,) the camera centre: of the estimate, else the true pose, else the prior."""
    estimate = record.localization.T_camera_map
    pose = record.frame.T_map_camera if estimate is None else estimate.inverse()
    return record.localization.around_m if pose is None else pose.translation


def _place(element: Elements3D, eye_m: FloatArray) -> tuple[views_frame.EndView, ...]:
    """Return distance and 1 sigma across, along the line of sight and up (m), for each end."""
    covariance_m2 = element.covariance_m2[0]
    is_line = bool(element.is_line[0])
    points_m = {"top" if is_line else "center": element.anchor_m[0]}
    known = [element.anchor_known[0], element.end_known[0]]
    if is_line:
        points_m["bottom"] = element.end_m[0]
    return tuple(
        views_frame.EndView(
            end=end,
            known=bool(known[row]),
            distance_m=float(np.linalg.norm(point_m - eye_m)),
            sigma_m=_sigmas_m(_block(covariance_m2, row), point_m - eye_m),
        )
        for row, (end, point_m) in enumerate(points_m.items())
    )


def _block(covariance_m2: FloatArray, row: int) -> FloatArray:
    """Return the (3, 3) covariance of the anchor (row 0) or the end (row 1)."""
    return covariance_m2[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]


def _sigmas_m(covariance_m2: FloatArray, sight_m: FloatArray) -> tuple[float, float, float]:
    """Return 1 sigma across and along a line of sight on the ground plane, and up (m)."""
    heading = np.arctan2(sight_m[1], sight_m[0])
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    axes = np.stack([across, along, [0.0, 0.0, 1.0]])
    variance = np.einsum("ki,ij,kj->k", axes, covariance_m2, axes)
    across_m, along_m, up_m = np.sqrt(np.maximum(variance, 0.0)).tolist()
    return across_m, along_m, up_m


def _meaning(run: Run, element_id: int) -> str:
    """Return the basis of the sigmas of ``_place``, in one line."""
    provenance = provenance_of(run.semantic_map, element_id)
    if provenance is None:
        return "1σ from this camera, as stated by the map, which does not give its source."
    count = len(provenance.observation_ids)
    what = "labels and detections" if uses_detections(run.semantic_map) else "labels"
    return f"1σ from this camera, based on {count} {what}. Errors of their poses are not included."


def _in_run(run: Run, element_id: int) -> tuple[tuple[str, str], ...]:
    """Return the numbers of frames in which it is matched and, if known, detected."""
    table = frame_table(run)
    pair_frame, is_own = table.frame_of_pair(), table.pair_id == element_id

    def frames(chosen: BoolArray) -> int:
        return len(np.unique(pair_frame[is_own & chosen]))

    total = f"of {len(table)} frames"
    matched = frames(np.full(len(is_own), True))
    rows = [("Matched, inlier", f"{matched}, {frames(table.pair_inlier)} {total}")]
    if (table.detected_id >= 0).any():
        detected = np.unique(table.frame_of_detection()[table.detected_id == element_id])
        correct = frames(table.pair_is_true)
        rows.append(("Detected, matched correctly", f"{len(detected)}, {correct} {total}"))
    return tuple(rows)


def _decisions(run: Run, element_id: int) -> tuple[views_frame.MapDecision, ...]:
    """Return the decisions about the label elements behind a map element."""
    provenance = provenance_of(run.semantic_map, element_id)
    labels = set() if provenance is None else set(provenance.label_ids)
    decisions = run.semantic_map.decisions
    class_id = int(mapped(run, element_id).class_id[0])
    return tuple(
        _decision(run, decision, class_id)
        for decision in decisions
        if labels & set(decision.label_ids)
    )


def _decision(run: Run, decision: Decision, class_id: int) -> views_frame.MapDecision:
    classes = run.semantic_map.classes
    names = tuple(classes.element_name(class_id, number) for number in decision.numbers)
    return views_frame.MapDecision(
        kind=decision.kind, by=decision.by, reason=decision.reason, names=names
    )


def origins_view(run: Run, origins: Origins, element_id: int) -> views_frame.OriginsEvent:
    """Return the label elements behind a map element, or the reason why there are none."""
    try:
        entries, reason = origins.of(element_id), origins.why_none(element_id)
    except SemvizError as error:
        entries, reason = (), str(error)
    return views_frame.OriginsEvent(
        element=element_id,
        reason=reason,
        entries=tuple(_origin(run, origin) for origin in entries),
    )


def _origin(run: Run, origin: Origin) -> views_frame.OriginView:
    """Return a label element with its observations by frame and side, and its last writer."""
    sides: defaultdict[int, str] = defaultdict(str)
    for row in origin.used:
        sides[row.frame_index] += row.side[0].upper()
    element, writer = origin.element, origin.writer
    return views_frame.OriginView(
        name=run.semantic_map.classes.element_name(element.class_id, element.number),
        class_id=element.class_id,
        left=sum(row.side == "left" for row in origin.used),
        right=sum(row.side == "right" for row in origin.used),
        frames=tuple(sorted(sides.items())),
        others=origin.others,
        writer=None if writer is None else views_frame.WriterView(**writer._asdict()),
        is_newer=writer is not None and writer.number > run.semantic_map.operation,
    )

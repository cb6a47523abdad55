"""One element in the view "Tracks": its labels, what is wrong with them, and what could be done.

Nothing here changes labels. Searches of images take a while: call them without the session's lock.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from semviz.annotator.element_positions import ElementPositions, Position
from semviz.annotator.frame_quality import residual_px
from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import LabelProposal, inside
from semviz.annotator.tracks.detection_tracks import DetectionTrack
from semviz.annotator.tracks.track_rows import residual_of
from semviz.annotator.views import ElementRef, element_ref
from semviz.web.protocol import Part
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, Pixel
from semviz_annotation.labels.views import camera_of
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_annotation.storage.operations import LogEnd, Writer
from semviz_annotation.storage.placement import is_accepted
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Side

SUSPECT_PX = 2.0
"""Labels that all fit better than this show one element."""
MOST_SPLITS = 24
"""Frames that are tried as the first one of another element."""
SPLIT_GAIN = 30.0
"""By how much two elements must fit better than one, as chi squared with 4 more parameters: chance
reaches it once in 200,000 elements."""
MERGE_M = 3.0
"""Elements farther apart are not offered for a merge."""
LEAST_PX, MOST_PX = 0.05, 4.0
"""A re-snap moves labels by more than the first, and not by more than the second: that would be
another edge."""


class TrackImage(Part):
    """A label or a detection of an element, with what the strip of views shows of it."""

    id: str
    frame: int
    side: Side
    anchor: Pixel
    end: Pixel | None
    px: float | None
    """Residual; None without a position."""
    size_px: float
    """How large the element appears there; 0 without a position."""


class TrackLabel(TrackImage):
    """A label of the element, with what the card shows of it, too."""

    accepted: bool
    """Whether a machine placed it, and a person accepted it."""


class TrackSplit(Part):
    """The labels fit two elements better than one."""

    frame: int
    """The first frame of the second one."""
    title: str
    text: str


class MergeOffer(ElementRef):
    """The nearest element of the same class that no image shows together with this one."""

    away_m: float


class TrackDetails(Part):
    """One element, as of an operation."""

    id: str
    operation: int
    hash: str
    labels: list[TrackLabel]
    """By frame, left first."""
    split: TrackSplit | None
    merge: MergeOffer | None
    place: str
    """Where it is, or why that is unknown."""
    drawn_by: str
    """Who drew how many, and how many were accepted."""


class TrackProposal(Part):
    """A proposed label of the element, confirmed by its image or not."""

    id: str
    frame: int
    side: Side
    anchor: Pixel
    end: Pixel | None
    anchor_known: bool
    end_known: bool
    score: float
    is_confident: bool


class SnapMove(Part):
    """Where a label snaps to."""

    observation_id: str
    anchor_px: Pixel
    end_px: Pixel | None


class ReSnapPreview(Part):
    """What a re-snap would do."""

    moves: list[SnapMove]
    by_px: float
    """Median of the moves."""
    unclear: int
    """Number of accepted labels without a clear edge: they stay."""
    drawn: int
    """Number of labels that a person placed: they stay."""


@dataclass(frozen=True, eq=False)
class TrackInspector:
    """Describes one element of ``labels``."""

    cameras: Cameras
    positions: ElementPositions
    labels: Labels
    end: LogEnd
    mapped: Mapping[str, Triangulated]

    def details(self, element_id: str, placed: Mapping[str, Writer]) -> TrackDetails:
        """Return the card of an element. Raise SemvizError if it does not exist."""
        element = self.labels.element(element_id)
        rows = self.labels.of_element(element_id)
        position = self.positions.of_observations(rows)
        at = position if isinstance(position, Triangulated) else None
        px = [residual_of(self.positions, row, position) for row in rows]
        panes = [_pane(row) for row in rows]
        sizes = [0.0] * len(rows) if at is None else self.cameras.sizes_px(at, panes).tolist()
        suspect = at is None or max((p for p in px if p is not None), default=0.0) > SUSPECT_PX
        return TrackDetails(
            id=element_id,
            operation=self.end.number,
            hash=self.end.hash,
            labels=[
                TrackLabel(
                    id=row.id,
                    frame=row.frame_index,
                    side=row.side,
                    anchor=row.anchor_px,
                    end=row.end_px,
                    px=None if p is None else round(p, 2),
                    size_px=round(size, 1) if np.isfinite(size) else 0.0,
                    accepted=row.id in placed and is_accepted(placed[row.id]),
                )
                for row, p, size in zip(rows, px, sizes, strict=True)
            ],
            split=best_split(self.positions, rows) if suspect else None,
            merge=None if at is None else self._merge(element, at),
            place=_place_text(position),
            drawn_by=_drawn_by(placed.values()),
        )

    def _merge(self, element: LabelElement, position: Triangulated) -> MergeOffer | None:
        images = {(row.frame_index, row.side) for row in self.labels.of_element(element.id)}
        offers = []
        for id_, other in self.mapped.items():
            candidate = self.labels.elements.get(id_)
            if candidate is None or id_ == element.id or candidate.class_id != element.class_id:
                continue
            away_m = _away_m(position, other)
            if away_m <= MERGE_M and images.isdisjoint(
                (row.frame_index, row.side) for row in self.labels.of_element(id_)
            ):
                offers.append((away_m, candidate))
        if not offers:
            return None
        away_m, nearest = min(offers, key=lambda offer: offer[0])
        ref = element_ref(nearest, self.labels.classes).model_dump()
        return MergeOffer(**ref, away_m=round(away_m, 2))


def detection_views(
    track: DetectionTrack, elements: Elements3D, cameras: Cameras
) -> list[TrackImage]:
    """Return the detections of an open track; ``elements`` holds that of the map alone."""
    views = [cameras.view(row.frame_index, row.side) for row in track.detections]
    depths_m = [float(view.depth_m(elements.anchor_m)[0]) for view in views]
    return [
        TrackImage(
            id=row.id,
            frame=row.frame_index,
            side=row.side,
            anchor=row.anchor_px,
            end=row.end_px,
            px=round(off_px, 2),
            size_px=round(float(view.camera.K[0, 0]) / depth_m, 1) if depth_m > 0.0 else 0.0,
        )
        for row, view, depth_m, off_px in zip(
            track.detections, views, depths_m, track.residuals_px, strict=True
        )
    ]


def best_split(positions: ElementPositions, rows: Sequence[Observation]) -> TrackSplit | None:
    """Return the frame from which on labels show something else, if that is beyond chance."""
    rows = positions.posed(rows)
    frames = sorted({row.frame_index for row in rows})
    starts = [after for _, after in pairwise(frames)]
    if len(starts) > MOST_SPLITS:
        starts = [starts[n] for n in np.linspace(0, len(starts) - 1, MOST_SPLITS).astype(int)]
    whole = _chi2(positions, rows, positions.of_observations(rows))
    best: tuple[float, int, Triangulated, Triangulated] | None = None
    for start in starts:
        parts = (
            [row for row in rows if row.frame_index < start],
            [row for row in rows if row.frame_index >= start],
        )
        first, second = (positions.of_observations(part) for part in parts)
        if isinstance(first, Triangulated) and isinstance(second, Triangulated):
            chi2 = _chi2(positions, parts[0], first) + _chi2(positions, parts[1], second)
            if best is None or chi2 < best[0]:
                best = chi2, start, first, second
    if best is None or whole - best[0] < SPLIT_GAIN:
        return None
    chi2, start, first, second = best
    before = max(frame for frame in frames if frame < start)
    fits = "they fit no single place" if np.isinf(whole) else f"χ² {whole:.0f}, apart {chi2:.0f}"
    return TrackSplit(
        frame=start,
        title=f"Two elements from frame {start} on",
        text=f"Frames {frames[0]}–{before} meet in one place, {start}–{frames[-1]} in another, "
        f"{_away_m(first, second):.2f} m apart ({fits}).",
    )


def _chi2(positions: ElementPositions, rows: Sequence[Observation], position: Position) -> float:
    """Return the sum of squared residuals, px; infinite without a position."""
    if not isinstance(position, Triangulated):
        return float("inf")
    return float(sum(residual_px(positions.view(row), row, position) ** 2 for row in rows))


def _away_m(first: Triangulated, second: Triangulated) -> float:
    """Return the distance of two signs, or of the middle of a pole from the other's line."""
    if not (first.is_line and second.is_line):
        return float(np.linalg.norm(first.anchor_m - second.anchor_m))
    middle = 0.5 * (second.anchor_m + second.end_m) - first.end_m
    along = first.anchor_m - first.end_m
    along = along / max(float(np.linalg.norm(along)), 1e-9)
    return float(np.linalg.norm(middle - (middle @ along) * along))


def _place_text(position: Position) -> str:
    if not isinstance(position, Triangulated):
        return position.reason
    sigma_m = float(np.sqrt(np.trace(position.covariance_m2[:3, :3])))
    return f"{sigma_m:.2f} m, 1σ" if sigma_m < 100.0 else "uncertain along the rays"


def _drawn_by(writers: Iterable[Writer]) -> str:
    """``mara 46, accepted 11``"""
    counts: Counter[str] = Counter()
    accepted = 0
    for writer in writers:
        if is_accepted(writer):
            accepted += 1
        else:
            counts[writer.author] += 1
    names = [f"{name} {count}" for name, count in counts.most_common()]
    return ", ".join([*names, *([f"accepted {accepted}"] if accepted else [])])


def _pane(row: Observation) -> Pane:
    return Pane(row.frame_index, row.side)


def track_proposals(
    proposals: Iterable[LabelProposal], element_id: str, index: int, cameras: Cameras
) -> list[TrackProposal]:
    """Return the proposals of an element in the images of one frame."""
    found = []
    for proposal in proposals:
        is_here = proposal.pane.frame_index == index and proposal.element_id == element_id
        if not is_here or proposal.is_rejected or proposal.mark is None or proposal.score is None:
            continue
        mark = inside(proposal.mark, camera_of(cameras.rig, proposal.pane.side)[0])
        if mark is not None:
            found.append(
                TrackProposal(
                    id=proposal.id,
                    frame=index,
                    side=proposal.pane.side,
                    anchor=mark.anchor_px,
                    end=mark.end_px,
                    anchor_known=mark.anchor_known,
                    end_known=mark.end_known,
                    score=proposal.score,
                    is_confident=proposal.is_confident,
                )
            )
    return found


def preview_resnap(
    rows: Sequence[Observation],
    class_id: int,
    placed: Mapping[str, Writer],
    worker: ImageWorker,
    cameras: Cameras,
) -> ReSnapPreview:
    """Return where accepted labels snap to; what a person placed stays. It reads all images."""
    moves, by_px, unclear, drawn = [], [], 0, 0
    for row in rows:
        if row.id not in placed or not is_accepted(placed[row.id]):
            drawn += 1
            continue
        snapped = worker.snap(_pane(row), Mark.of(row), class_id)
        camera = camera_of(cameras.rig, row.side)[0]
        mark = None if snapped is None else inside(snapped.mark, camera)
        if snapped is None or mark is None or snapped.moved_px > MOST_PX:
            unclear += 1
        elif snapped.moved_px >= LEAST_PX:
            moves.append(
                SnapMove(observation_id=row.id, anchor_px=mark.anchor_px, end_px=mark.end_px)
            )
            by_px.append(snapped.moved_px)
    median_px = round(float(np.median(by_px)), 2) if by_px else 0.0
    return ReSnapPreview(moves=moves, by_px=median_px, unclear=unclear, drawn=drawn)

"""The table of a run: small columns over all frames, so that lists, plots and counts read no frame.

It is made of the frames, and a complete run also has it at its end. Values are those that the
functions of `metrics` and `diagnosis` give for each frame.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import get_args
from weakref import WeakKeyDictionary

import numpy as np

from semviz.runs.diagnosis import diagnosis_name, noticed_faults
from semviz.runs.metrics import OVERCONFIDENT_M, errors_of
from semviz.runs.run import FrameRecord, Run
from semviz_core.base.localization import Status
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

STATUSES: tuple[Status, ...] = get_args(Status)


@dataclass(frozen=True, eq=False)
class FrameTable:
    """Columns over the n frames of a run, their k detections and m estimated pairs.

    Positions are of the left camera in the map frame, NaN where unknown.
    """

    index: IntArray
    """(n,) frame numbers."""
    time_s: FloatArray
    status: IntArray
    """(n,) rows of ``STATUSES``."""
    distance_m: FloatArray
    """(n,) pose errors; NaN without a pose or a true one."""
    angle_deg: FloatArray
    solve_ms: FloatArray
    truth_m: FloatArray
    """(n, 3)"""
    estimate_m: FloatArray
    """(n, 3)"""
    prior_m: FloatArray
    """(n, 3)"""
    around_m: FloatArray
    """(n, 3) ``Localization.around_m``, which is always known."""
    texts: tuple[str, ...]
    """All different texts; the next three columns are rows of it."""
    reason: IntArray
    diagnosis: IntArray
    noticed: IntArray
    detections: IntArray
    """(n,) number of detections of each frame."""
    detected_id: IntArray
    """(k,) true element of each detection, as in ``FrameRecord.element_id``."""
    pairs: IntArray
    """(n,) number of pairs of each frame's estimate."""
    pair_id: IntArray
    """(m,) element of each pair."""
    pair_inlier: BoolArray
    pair_is_true: BoolArray
    pair_px: FloatArray
    """(m,) length of the residual."""

    def __len__(self) -> int:
        return len(self.index)

    @property
    def is_ok(self) -> BoolArray:
        """(n,) whether the status is ok."""
        return np.asarray(self.status == STATUSES.index("ok"))

    @property
    def is_overconfident(self) -> BoolArray:
        """(n,) whether the status is ok, but the pose is more than 1 m off."""
        return self.is_ok & (self.distance_m > OVERCONFIDENT_M)

    @property
    def has_truth(self) -> BoolArray:
        """(n,) whether the true pose is known."""
        return np.asarray(np.isfinite(self.truth_m).all(axis=1))

    def texts_of(self, rows: IntArray) -> list[str]:
        """Return the texts of a column."""
        return [self.texts[row] for row in rows.tolist()]

    def position_of(self, index: int) -> int | None:
        """Return the position of the frame with a number."""
        found = np.flatnonzero(self.index == index)
        return int(found[0]) if len(found) else None

    def frame_of_detection(self) -> IntArray:
        """Return (k,) the position of each detection's frame."""
        return np.repeat(np.arange(len(self)), self.detections)

    def frame_of_pair(self) -> IntArray:
        """Return (m,) the position of each pair's frame."""
        return np.repeat(np.arange(len(self)), self.pairs)


NOWHERE = np.full(3, np.nan)


@dataclass(eq=False)
class TableBuilder:
    """Makes the table of a run, frame by frame."""

    run: Run
    """Frames are added; its own are not read."""
    rows: list[tuple[float, ...]] = field(default_factory=list)
    positions: list[FloatArray] = field(default_factory=list)
    texts: dict[str, int] = field(default_factory=dict)
    named: list[tuple[int, int, int]] = field(default_factory=list)
    detected: list[IntArray] = field(default_factory=list)
    paired: list[FloatArray] = field(default_factory=list)

    def add(self, record: FrameRecord) -> None:
        """Add a frame, which is diagnosed if need be."""
        result, errors = record.localization, errors_of(record)
        self.rows.append((
            record.frame.index,
            record.frame.time_s,
            STATUSES.index(result.status),
            np.nan if errors is None else errors.distance_m,
            np.nan if errors is None else errors.angle_deg,
            sum(result.time_ms.values()),
        ))  # fmt: skip
        estimate = None if result.T_camera_map is None else result.T_camera_map.inverse()
        prior_m = NOWHERE if result.prior is None else result.prior.position_m
        centers = (_center(record.frame.T_map_camera), _center(estimate), prior_m, result.around_m)
        self.positions.append(np.stack(centers))
        name = diagnosis_name(self.run, record)
        texts = result.reason, name, noticed_faults(self.run, record)
        reason, diagnosis, noticed = (
            self.texts.setdefault(text, len(self.texts)) for text in texts
        )
        self.named.append((reason, diagnosis, noticed))
        self.detected.append(record.element_id)
        self.paired.append(_pairs(record))

    def table(self) -> FrameTable:
        """Return the table of the frames added so far."""
        index, time_s, status, distance_m, angle_deg, solve_ms = _columns(self.rows, 6).T
        positions_m = np.array(self.positions).reshape(-1, 4, 3)
        reason, diagnosis, noticed = _columns(self.named, 3).astype(np.int64).T
        pairs = np.concatenate([np.zeros((0, 4)), *self.paired])
        return FrameTable(
            index=index.astype(np.int64),
            time_s=time_s,
            status=status.astype(np.int64),
            distance_m=distance_m,
            angle_deg=angle_deg,
            solve_ms=solve_ms,
            truth_m=positions_m[:, 0],
            estimate_m=positions_m[:, 1],
            prior_m=positions_m[:, 2],
            around_m=positions_m[:, 3],
            texts=tuple(self.texts),
            reason=reason,
            diagnosis=diagnosis,
            noticed=noticed,
            detections=np.array([len(ids) for ids in self.detected], dtype=np.int64),
            detected_id=np.concatenate([np.zeros(0, np.int64), *self.detected]),
            pairs=np.array([len(rows) for rows in self.paired], dtype=np.int64),
            pair_id=pairs[:, 0].astype(np.int64),
            pair_inlier=pairs[:, 1] > 0,
            pair_is_true=pairs[:, 2] > 0,
            pair_px=pairs[:, 3],
        )


def _columns(rows: Sequence[tuple[float, ...]], columns: int) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _center(T_map_camera: Pose | None) -> FloatArray:
    return NOWHERE if T_map_camera is None else T_map_camera.translation


def _pairs(record: FrameRecord) -> FloatArray:
    """Return (m, 4) element, whether inlier, whether true, and residual (px) of each pair."""
    refinement, submap = record.localization.refinement, record.localization.submap
    if refinement is None:
        return np.zeros((0, 4))
    i, j = refinement.pairs.T
    size_px = np.sqrt(np.nansum(refinement.residual_px**2, axis=1))
    is_true = record.element_id[i] == submap.id[j]
    return np.stack([submap.id[j], refinement.inlier, is_true, size_px], axis=1)


KNOWN_TABLES: WeakKeyDictionary[Run, FrameTable] = WeakKeyDictionary()
"""Tables of runs, as read or made."""
Watch = Callable[[Iterable[FrameRecord], int], Iterator[FrameRecord]]
"""Yields the frames it is given, of which there are so many."""


def frame_table(run: Run, watch: Watch = lambda frames, _: iter(frames)) -> FrameTable:
    """Return the table of a run: that of its file, or one made of its frames, once."""
    if run not in KNOWN_TABLES:
        builder = TableBuilder(run)
        for record in watch(run.frames, len(run.frames)):
            builder.add(record)
        KNOWN_TABLES[run] = builder.table()
    return KNOWN_TABLES[run]

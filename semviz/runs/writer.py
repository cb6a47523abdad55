"""Write runs as .rrd files that rerun displays, and repair truncated or damaged ones.

A written run is read back bit for bit, or not at all: each frame has a checksum. Repair writes all
sound frames of a run to a new file.
"""

import atexit
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from semviz.runs import rerun_plots, rerun_scene, run
from semviz.runs.codec import Pools, encode, row_checksum
from semviz.runs.columns import FRAME, Columns
from semviz.runs.frame_table import TableBuilder
from semviz.runs.images import relocate_images
from semviz.runs.reader import load_run
from semviz.runs.rerun_scene import RerunScene
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.runs.stored_run import StoredTable
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import check_output, check_replaceable, replacing


def make_blueprint(info: RunInfo, semantic_map: SemanticMap) -> Any:
    """Return rerun's layout: 3D view and image, texts and matrix on the right, plots below."""
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(_map_view(semantic_map), _image_views(info), row_shares=[6, 5]),
                _texts_and_matrix(),
                column_shares=[5, 2],
            ),
            _plots(),
            row_shares=[7, 4],
        ),
        rrb.TimePanel(timeline=FRAME, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _map_view(semantic_map: SemanticMap) -> Any:
    """Map and poses in 3D, from behind the camera; both paths are shown at all times."""
    everything = rrb.VisibleTimeRanges(
        timeline=FRAME,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.infinite(),
    )
    paths: dict[Any, Any] = dict.fromkeys((rerun_scene.TRUE_PATH, rerun_scene.PATH), everything)
    start, behind = _start_and_eye(semantic_map.trajectory_m)
    return rrb.Spatial3DView(
        name="Map and poses",
        origin="/map",
        contents=["$origin/**", f"- {run.RIGHT_CAMERA}/**"],
        overrides=paths,
        eye_controls=rrb.EyeControls3D(
            position=behind, look_target=start, tracking_entity=rerun_scene.HERE
        ),
    )


def _image_views(info: RunInfo) -> Any:
    image = rrb.Spatial2DView(name="Image", origin=run.IMAGE)
    if info.images != "both":
        return image
    return rrb.Tabs(image, rrb.Spatial2DView(name="Right image", origin=run.IMAGE_RIGHT))


def _texts_and_matrix() -> Any:
    return rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(name="Why", origin=rerun_plots.WHY),
            rrb.TextDocumentView(name="How to read this", origin=rerun_scene.README),
        ),
        rrb.Spatial2DView(name="Match probability", origin=rerun_scene.MATRIX),
    )


def _plots() -> Any:
    """Errors, status and diagnosis over the frames, numbers of elements, and reasons."""
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(FRAME)],
        text_log_columns=["loglevel", "body"],
    )
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.Tabs(
                _error_view("Error, m", rerun_plots.ERROR_M),
                _error_view("Error, deg", rerun_plots.ERROR_DEG),
            ),
            rrb.StateTimelineView(
                name="Status and diagnosis",
                contents=[rerun_plots.STATUSES, rerun_plots.DIAGNOSES],
            ),
            row_shares=[1, 1],
        ),
        rrb.TimeSeriesView(name="Elements", origin=rerun_plots.COUNTS),
        rrb.TextLogView(name="Reasons", origin=rerun_plots.WHY, columns=columns),
        column_shares=[3, 2, 2],
    )


def _error_view(name: str, origin: str) -> Any:
    return rrb.TimeSeriesView(name=name, origin=origin, plot_legend=rrb.PlotLegend(visible=False))


def _start_and_eye(road_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the start of the road (3,), and a point (3,) behind and above it."""
    if len(road_m) < 2:
        return np.zeros(3), np.array([-25.0, -8.0, 15.0])
    ahead = road_m[min(len(road_m) - 1, 10)] - road_m[0]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return road_m[0], road_m[0] - 25.0 * ahead + np.array([0.0, 0.0, 15.0])


FLUSH_LIMIT_S = 30.0
"""For one frame. If the disk is full, rerun may report it, or wait for ever."""
FRAMES_PER_BATCH = 20
"""Frames drawn at once, which halves time and file size. A killed run keeps the values and images
of all its frames; the last few are not drawn."""
_FAILED: list[object] = []
"""Native recordings whose file failed, kept because rerun would wait for the file on release."""


class RunWriter:
    """Writes a run, frame by frame, to its path; an earlier run there is replaced at once.

    Each frame is flushed to the operating system before ``write`` returns, so a killed run keeps
    all of them. Leaving the context without an exception marks the run as complete, if
    ``completes``. Raise SemvizError if ``path`` cannot be written, or the disk is full; it names
    ``shown``, which is the path unless that is a temporary one.
    """

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        semantic_map: SemanticMap,
        *,
        completes: bool = True,
        lost: int = 0,
        shown: Path | None = None,
    ) -> None:
        _check_writable(path)
        self._shown = shown or path
        self._completes = completes
        self._lost_frames = lost
        self._lost = False
        self.frames = 0
        """Number of frames written."""
        self._last_index: int | None = None
        self._path = path
        self._places = list[tuple[int, int]]()
        """First byte of each frame's messages in the file, and the byte after them."""
        self._stream = rr.RecordingStream(run.APPLICATION, send_properties=False)
        self._stream.save(path, default_blueprint=make_blueprint(info, semantic_map))
        self._stream.send_recording_name(info.name)
        columns = Columns()
        _add_exact(columns, run.INFO, info, version=run.FORMAT_VERSION)
        _add_exact(columns, run.MAP, semantic_map)
        columns.send(self._stream)
        self._scene = RerunScene(self._stream, info, semantic_map)
        self._table = TableBuilder(self._scene.run)
        self._drawn = Columns()
        self._flush()

    def write(self, record: FrameRecord) -> None:
        """Add a frame. Raise ValueError if frame numbers do not increase."""
        frame = record.frame
        if self._last_index is not None and frame.index <= self._last_index:
            raise ValueError(f"frame {frame.index} comes after frame {self._last_index}")
        self._drawn.begin(frame.index, frame.time_s)
        self._scene.draw(self._drawn, record)
        if self._drawn.frames == FRAMES_PER_BATCH:
            self._send_drawn()
            self._flush()
        start = self._size()
        columns = Columns()
        columns.begin(frame.index, frame.time_s)
        columns.jpeg(run.IMAGE, record.image)
        if record.image_right is not None:
            columns.jpeg(run.IMAGE_RIGHT, record.image_right)
        if record in run.KNOWN_DIAGNOSES:  # by drawing it
            _add_exact(columns, run.DIAGNOSIS, run.KNOWN_DIAGNOSES[record], frame.index)
        # Last, so that a frame with readable values has its images too.
        _add_exact(columns, run.FRAME, record, frame.index, ordinal=self.frames)
        columns.send(self._stream)
        self._flush()
        self._places.append((start, self._size()))
        self._table.add(record)
        self._last_index = frame.index
        self.frames += 1

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._lost:
            return
        if self._drawn.frames:
            self._send_drawn()
        if kind is None and self._completes:
            self._send_table()
            columns = Columns()
            frames = {"frames": np.array([self.frames + self._lost_frames])}
            _add_checked(columns, run.END, frames, row_checksum(run.END, 0, frames))
            columns.send(self._stream)
        self._flush()
        self._stream.disconnect()

    def _send_drawn(self) -> None:
        self._drawn.send(self._stream)
        self._drawn = Columns()

    def _send_table(self) -> None:
        self._flush()
        start, stop = np.array(self._places, np.int64).reshape(-1, 2).T
        columns = Columns()
        _add_exact(columns, run.TABLE, StoredTable(self._table.table(), start, stop, self._size()))
        columns.send(self._stream)
        self._flush()

    def _size(self) -> int:
        return self._path.stat().st_size

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_LIMIT_S)
        except RuntimeError as error:
            self._lost = True
            _FAILED.append(self._stream.inner)
            atexit.unregister(rr.rerun_shutdown)
            raise SemvizError(
                f"{self._shown}: cannot be written ({error}); is the disk full?"
            ) from None


def write_run(
    records: Iterable[FrameRecord], path: Path, info: RunInfo, semantic_map: SemanticMap
) -> Counter[str]:
    """Write a run to ``path``. Return the number of frames with each status.

    An interrupted run stays beside it as ``NAME.partial.rrd``, readable up to its last frame; an
    earlier run at ``path`` is only replaced by a complete one. Raise SemvizError if ``path``
    cannot be written.
    """
    counts: Counter[str] = Counter()
    with unfinished_run(path, info, semantic_map) as writer:
        for record in records:
            writer.write(record)
            counts[record.localization.status] += 1
    return counts


@contextmanager
def unfinished_run(path: Path, info: RunInfo, semantic_map: SemanticMap) -> Iterator[RunWriter]:
    """Yield the writer of a run whose file gets its name when the block ends; see ``write_run``."""
    check_replaceable(path)
    unfinished = path.with_name(f"{path.stem}.partial.rrd")
    _remove_earlier(unfinished)
    writer: RunWriter | None = None
    try:
        with RunWriter(unfinished, info, semantic_map) as writer:
            yield writer
    except BaseException:
        if writer is None or not writer.frames:  # the file has no frames
            with suppress(OSError):
                unfinished.unlink()
        raise
    unfinished.replace(path)


def _remove_earlier(unfinished: Path) -> None:
    """Remove an earlier unfinished run, which a link may lead to; refuse to remove another file."""
    check_output(unfinished, lambda head: head.startswith(b"RRF2"), can_force=False)
    try:
        unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise SemvizError(f"{unfinished}: cannot be written ({error.strerror})") from None


def _add_exact(
    columns: Columns, entity: str, value: object, frame: int = 0, **numbers: int
) -> None:
    """Add a value as a row, with further numbers by name, and the row's checksum."""
    images = tuple[bytes | None, ...]()
    if isinstance(value, FrameRecord):
        images = (value.image, value.image_right)
        value = replace(value, image=None, image_right=None)
    structure, pools = encode(value)
    row = pools | {name: np.array([number]) for name, number in numbers.items()}
    text = json.dumps(structure)
    columns.text(entity, run.STRUCTURE, text, kind="")
    checksum = row_checksum(entity, frame, {run.STRUCTURE: text, **row}, images)
    _add_checked(columns, entity, row, checksum)


def _add_checked(columns: Columns, entity: str, row: Pools, checksum: int) -> None:
    for name, numbers in (row | {run.CHECKSUM: np.array([checksum])}).items():
        columns.add(entity, name, numbers)


def _check_writable(path: Path) -> None:
    """Raise SemvizError if ``path`` cannot be written; rerun does not always report it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("wb").close()
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None


def repair(path: Path, out: Path) -> Run:
    """Write all sound frames of the run in ``path`` to ``out``, which may be the same file.

    An interrupted run stays marked as such, and damaged frames stay counted as lost.
    Raise SemvizError if ``path`` cannot be read, or ``out`` cannot be written.
    """
    recorded = load_run(path)
    with (
        replacing(out) as temporary,
        RunWriter(
            temporary,
            recorded.info,
            recorded.semantic_map,
            completes=recorded.complete,
            lost=recorded.lost,
            shown=out,
        ) as writer,
    ):
        for frame in recorded.frames:
            writer.write(relocate_images(frame, path.parent, out.parent))
    return recorded

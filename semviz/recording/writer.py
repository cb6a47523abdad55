"""Runs on disk: one .rrd file that rerun shows and that our reader gets back bit for bit."""

import atexit
import json
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
import rerun as rr

from semviz.recording import layout
from semviz.recording.blueprint import make_blueprint
from semviz.recording.codec import encode
from semviz.recording.columns import Columns
from semviz.recording.run import FrameRecord, RunInfo
from semviz.recording.scene import Scene
from semviz_core.errors import SemvizError
from semviz_core.files import check_replaceable
from semviz_core.semantic_map import SemanticMap

FLUSH_LIMIT_S = 30.0
"""For one frame. Where the disk is full rerun may say so, or leave us waiting for ever."""
DRAWN_TOGETHER = 20
"""So many frames are handed to rerun's eyes at once, which saves half of the time and of the room.
A killed run keeps the numbers and images of all its frames; the last few are not drawn."""
_LOST: list[object] = []
"""Native recordings whose file failed: rerun would wait for it once more on letting them go."""


class RunWriter:
    """Writes a run, frame by frame, at its final path.

    Every frame is in the operating system's hands when ``write`` returns, so a killed run keeps
    all frames written; leaving the context without an exception marks the run as
    complete, if it ``completes``.
    A run that was at ``path`` before is replaced at once. Raises SemvizError where ``path``
    cannot be written, also when the disk is full in the middle.
    """

    def __init__(
        self, path: Path, info: RunInfo, semantic_map: SemanticMap, *, completes: bool = True
    ) -> None:
        _check_writable(path)
        self._path = path
        self._completes = completes
        self._lost = False
        self._frames = 0
        self._last_index: int | None = None
        self._stream = rr.RecordingStream(layout.APPLICATION, send_properties=False)
        self._stream.save(path, default_blueprint=make_blueprint(info, semantic_map))
        self._stream.send_recording_name(info.name)
        columns = Columns()
        columns.add(layout.INFO, "version", np.array([layout.FORMAT_VERSION]))
        _add_exact(columns, layout.INFO, info)
        _add_exact(columns, layout.MAP, semantic_map)
        columns.send(self._stream)
        self._scene = Scene(self._stream, info, semantic_map)
        self._drawn = Columns()
        self._flush()

    def write(self, record: FrameRecord) -> None:
        """Add one frame. Frame numbers go up; ValueError where one does not."""
        frame = record.frame
        if self._last_index is not None and frame.index <= self._last_index:
            raise ValueError(f"frame {frame.index} comes after frame {self._last_index}")
        self._drawn.begin(frame.index, frame.time_s)
        self._scene.draw(self._drawn, record)
        if self._drawn.frames == DRAWN_TOGETHER:
            self._send_drawn()
        columns = Columns()
        columns.begin(frame.index, frame.time_s)
        columns.jpeg(layout.IMAGE, record.image)
        if record.image_right is not None:
            columns.jpeg(layout.IMAGE_RIGHT, record.image_right)
        # Last, so that a frame whose numbers are readable has its images too.
        _add_exact(columns, layout.FRAME, replace(record, image=None, image_right=None))
        columns.send(self._stream)
        self._flush()
        self._last_index = frame.index
        self._frames += 1

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
            columns = Columns()
            columns.add(layout.END, "frames", np.array([self._frames]))
            columns.send(self._stream)
        self._flush()
        self._stream.disconnect()

    def _send_drawn(self) -> None:
        self._drawn.send(self._stream)
        self._drawn = Columns()

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH_LIMIT_S)
        except RuntimeError as error:
            self._lost = True
            _LOST.append(self._stream.inner)
            atexit.unregister(rr.rerun_shutdown)
            raise SemvizError(
                f"{self._path}: cannot be written ({error}); is the disk full?"
            ) from None


def write_run(
    records: Iterable[FrameRecord], path: Path, info: RunInfo, semantic_map: SemanticMap
) -> Counter[str]:
    """Write a whole run to ``path``; how many frames got which status.

    An interrupted one stays beside it as ``NAME.partial.rrd``, readable up to its last frame; an
    earlier run at ``path`` is only replaced by a complete one. Raises SemvizError where ``path``
    cannot be written.
    """
    check_replaceable(path)
    counts: Counter[str] = Counter()
    unfinished = path.with_name(f"{path.stem}.partial.rrd")
    try:
        with RunWriter(unfinished, info, semantic_map) as writer:
            for one in records:
                writer.write(one)
                counts[one.localization.status] += 1
    except BaseException:
        if not counts:  # nothing in it to read
            with suppress(OSError):
                unfinished.unlink()
        raise
    unfinished.replace(path)
    return counts


def _add_exact(columns: Columns, entity: str, value: object) -> None:
    structure, pools = encode(value)
    columns.text(entity, layout.STRUCTURE, json.dumps(structure), kind="")
    for name, numbers in pools.items():
        columns.add(entity, name, numbers)


def _check_writable(path: Path) -> None:
    """rerun itself writes to nowhere without an error in some of these cases."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("wb").close()
    except OSError as error:
        raise SemvizError(f"{path}: cannot be written ({error.strerror})") from None

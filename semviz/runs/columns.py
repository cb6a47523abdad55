"""Write many rerun entities of a frame as one Arrow record batch.

rerun's archetypes take 0.1 to 0.7 ms per call, and a frame needs about twenty. One batch with
the same columns takes about 1 ms, and hardly more for several frames. The layouts below are
those that the archetypes write, component by component.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray

FRAME, TIME = "frame", "time"
"""The two timelines: the sequence's own frame number, and seconds."""
_FLOAT32 = 34
"""rerun's ChannelDatatype.F32."""
_VECTOR = {d: pa.list_(pa.field("item", pa.float32(), nullable=False), d) for d in (2, 3, 9)}
_IMAGE_FORMAT = pa.struct(
    [
        pa.field("width", pa.uint32(), nullable=False),
        pa.field("height", pa.uint32(), nullable=False),
        pa.field("pixel_format", pa.uint8()),
        pa.field("color_model", pa.uint8()),
        pa.field("channel_datatype", pa.uint8()),
    ]
)


@dataclass(frozen=True, eq=False)
class Strips:
    """Line strips in 2D or 3D."""

    points: FloatArray
    """(sum of lengths, 2 or 3) of all strips, one after the other."""
    lengths: IntArray
    """(k,) number of points of each strip."""

    def __len__(self) -> int:
        return len(self.lengths)

    @classmethod
    def of(cls, strips: FloatArray) -> "Strips":
        """Return k strips of p points each, from (k, p, 2 or 3)."""
        k, p, d = strips.shape
        return cls(strips.reshape(k * p, d), np.full(k, p))


AsArrow = Callable[[list[Any]], Any]
"""Converts the values of several frames to one Arrow array."""


def _numbers(values: list[NDArray[Any]]) -> Any:
    return pa.array(np.concatenate(values))


def _texts(values: list[Sequence[str]]) -> Any:
    return pa.array(list(chain.from_iterable(values)), pa.string())


def _vectors(values: list[FloatArray]) -> Any:
    """Return vectors (k, d) as a fixed-size list array of float32."""
    vectors = np.concatenate(values).astype(np.float32)
    return pa.FixedSizeListArray.from_arrays(
        pa.array(vectors.reshape(-1)), type=_VECTOR[vectors.shape[1]]
    )


def _strips(values: list[Strips]) -> Any:
    points = _vectors([value.points for value in values])
    return _pieces(np.concatenate([value.lengths for value in values]), points)


def _blobs(values: list[list[NDArray[np.uint8]]]) -> Any:
    blobs = list(chain.from_iterable(values))
    data = np.concatenate(blobs) if blobs else np.zeros(0, np.uint8)
    return _pieces(np.array([len(blob) for blob in blobs], np.int64), pa.array(data))


def _formats(values: list[list[dict[str, int]]]) -> Any:
    return pa.array(list(chain.from_iterable(values)), _IMAGE_FORMAT)


def _pieces(lengths: IntArray, values: Any) -> Any:
    """Return consecutive pieces of ``values`` as the rows of a list array."""
    kind = pa.list_(pa.field("item", values.type, nullable=False))
    return pa.ListArray.from_arrays(pa.array(_offsets(lengths)), values, type=kind)


def _offsets(lengths: IntArray) -> NDArray[np.int32]:
    offsets = np.zeros(len(lengths) + 1, np.int32)
    np.cumsum(lengths, out=offsets[1:])
    return offsets


@dataclass(eq=False)
class _Column:
    """One component of one entity."""

    kind: str
    as_arrow: AsArrow
    rows: list[int] = field(default_factory=list)
    """Rows of the batch with a value; the other rows leave the component as it is."""
    values: list[Any] = field(default_factory=list)
    """The value of each of these rows."""

    def array(self, rows: int) -> Any:
        """Return a list array with ``rows`` rows."""
        lengths, has_value = np.zeros(rows, np.int64), np.zeros(rows, bool)
        lengths[self.rows], has_value[self.rows] = [len(value) for value in self.values], True
        mask = None if has_value.all() else pa.array(~has_value)
        values = self.as_arrow(self.values)
        return pa.ListArray.from_arrays(pa.array(_offsets(lengths)), values, mask=mask)


class Columns:
    """Collects columns of many entities, for the frames that were begun or as static data.

    An empty component removes that of earlier frames. Values are converted when they are sent, so
    they must not change before.
    """

    def __init__(self) -> None:
        self._frames: list[int] = []
        self._nanoseconds: list[int] = []
        self._columns: dict[tuple[str, str], _Column] = {}

    @property
    def frames(self) -> int:
        """Number of frames that were begun."""
        return len(self._frames)

    def begin(self, frame: int, time_s: float) -> None:
        """Begin a frame: values added from now on belong to it."""
        self._frames.append(frame)
        self._nanoseconds.append(round(time_s * 1e9) if np.isfinite(time_s) else 0)

    def send(self, stream: rr.RecordingStream) -> None:
        """Send all columns in one call."""
        fields, arrays, index = [], [], None
        if self._frames:
            index = [FRAME, TIME]
            arrays = [pa.array(self._frames), pa.array(self._nanoseconds, pa.duration("ns"))]
            fields = [pa.field(name, array.type) for name, array in zip(index, arrays, strict=True)]
        for (entity, component), column in self._columns.items():
            array = column.array(max(self.frames, 1))
            arrays.append(array)
            fields.append(_field(entity, component, array.type, column.kind))
        batch = pa.record_batch(arrays, schema=pa.schema(fields))
        stream.send_record_batch(batch, index=index)

    def add(
        self,
        entity: str,
        component: str,
        values: Any,
        kind: str = "",
        as_arrow: AsArrow = _numbers,
    ) -> None:
        """Add the values of a component; ``kind`` is rerun's component type, empty for our own."""
        key = entity, component
        if key not in self._columns:
            self._columns[key] = _Column(kind, as_arrow)
        column = self._columns[key]
        column.rows.append(max(self.frames - 1, 0))
        column.values.append(values)

    def text(self, entity: str, component: str, text: str, kind: str = "Text") -> None:
        """Add a text; ``kind`` is empty for our own components."""
        self.add(entity, component, [text], kind, _texts)

    def scalars(self, entity: str, *values: float) -> None:
        """Add one value for each line of a plot; NaN leaves a gap."""
        self.add(entity, "Scalars:scalars", np.array(values, np.float64), "Scalar")

    def colors(self, entity: str, archetype: str, colors: IntArray) -> None:
        """Add one colour 0xRRGGBBAA (k,) for each instance of the entity."""
        self.add(entity, f"{archetype}:colors", colors.astype(np.uint32), "Color")

    def points(self, entity: str, points: FloatArray, colors: IntArray | None = None) -> None:
        """Add points (k, 2) or (k, 3), with colours (k,) or in the entity's own colour."""
        d = points.shape[1]
        self.add(entity, f"Points{d}D:positions", points, f"Position{d}D", _vectors)
        if colors is not None:
            self.colors(entity, f"Points{d}D", colors)

    def strips(self, entity: str, strips: Strips, colors: IntArray | None = None) -> None:
        """Add line strips, with colours (k,) or in the entity's own colour."""
        d = strips.points.shape[1]
        self.add(entity, f"LineStrips{d}D:strips", strips, f"LineStrip{d}D", _strips)
        if colors is not None:
            self.colors(entity, f"LineStrips{d}D", colors)

    def labels(
        self, entity: str, archetype: str, labels: Sequence[str], *, show: bool | None = None
    ) -> None:
        """Add labels of the entity's instances; ``show`` shows them always, not on hover only."""
        self.add(entity, f"{archetype}:labels", labels, "Text", _texts)
        if show is not None:
            self.add(entity, f"{archetype}:show_labels", np.array([show]), "ShowLabels")

    def radius(self, entity: str, archetype: str, points: float) -> None:
        """Set the size in screen points, independent of the zoom."""
        self.add(entity, f"{archetype}:radii", np.array([-points], np.float32), "Radius")

    def pose(self, entity: str, pose: Pose) -> None:
        """Set the entity's pose in its parent: T_parent_entity."""
        columns = pose.rotation.T.reshape(1, 9)  # rerun: column-major
        self.add(entity, "Transform3D:mat3x3", columns, "TransformMat3x3", _vectors)
        shift = pose.translation[None]
        self.add(entity, "Transform3D:translation", shift, "Translation3D", _vectors)

    def image_plane_distance(self, entity: str, meters: float) -> None:
        """Set the distance from the camera, and so the size, at which an image is drawn."""
        component = "Pinhole:image_plane_distance"
        self.add(entity, component, np.array([meters], np.float32), "ImagePlaneDistance")

    def jpeg(self, entity: str, image: bytes | None) -> None:
        """Add an image; None removes the earlier one."""
        blobs = [] if image is None else [np.frombuffer(image, np.uint8)]
        self.add(entity, "EncodedImage:blob", blobs, "Blob", _blobs)

    def matrix(self, entity: str, matrix: FloatArray | None) -> None:
        """Add a matrix (m, n), shown as a depth image; None removes the earlier one."""
        blobs, formats = [], []
        if matrix is not None and matrix.size:
            height, width = matrix.shape
            blobs = [np.ascontiguousarray(matrix, dtype="<f4").reshape(-1).view(np.uint8)]
            formats = [{"width": width, "height": height, "channel_datatype": _FLOAT32}]
        self.add(entity, "DepthImage:buffer", blobs, "ImageBuffer", _blobs)
        self.add(entity, "DepthImage:format", formats, "ImageFormat", _formats)


@cache
def _field(entity: str, component: str, arrow_type: Any, kind: str) -> Any:
    metadata = {"rerun:entity_path": entity, "rerun:component": component}
    if kind:
        metadata["rerun:archetype"] = "rerun.archetypes." + component.partition(":")[0]
        metadata["rerun:component_type"] = f"rerun.components.{kind}"
    return pa.field(f"{entity}:{component}", arrow_type, metadata=metadata)

"""Proposals of a detector, which a person may accept as labels; read from JSON or Parquet.

The workspace stores Parquet. Pixel (0, 0) is the centre of the top-left pixel.

JSON is ``{"format": "semviz-proposals", "version": 1, "proposals": [...]}``. Each proposal is
an object of ``frame_index``, ``side``, ``class`` (a name), ``anchor_px`` [u, v] and ``score``.
Optional fields are ``end_px`` (poles), ``anchor_known``, ``end_known``, ``sigma_px``,
``sigma_along_px``, ``detector``, ``id``, ``triangle_center`` and ``to_centroid_px``. Parquet has
the same fields as columns, points as ``anchor_u``, ``anchor_v``, ``end_u``, ``end_v``; missing
values are null. Its metadata records which images ``semviz detect`` has processed.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.labels.proposal import ProcessedImages, Proposal, proposal_content_id
from semviz_annotation.labels.rows import MIN_LENGTH_PX, Id, Index, Pixel
from semviz_core.base.camera import Rig
from semviz_core.base.classes import (
    DEFAULT_CLASSES,
    NEW_CENTER,
    OLDER_CENTER,
    TRIANGULAR,
    ClassSet,
    TriangleCenter,
)
from semviz_core.base.frame import Side
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import check_file, first_line, open_parquet, read_limited

FORMAT = "semviz-proposals"
VERSION = 1
PROCESSED_KEY = "semviz-detect"
"""Parquet metadata key of ``ProcessedImages``."""
SIGMA_PX = 2.0
"""Default standard deviation of the points, for detectors that state none."""
MAX_BYTES = 256 * 2**20
MAX_UNPACKED_BYTES = 2**30
MAX_PROPOSALS = 2_000_000
"""Limits of one file."""


@dataclass(frozen=True, eq=False)
class Proposals:
    """All proposals of a workspace, as a struct of arrays with one row per proposal."""

    id: tuple[str, ...] = ()
    frame_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    is_right: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    class_id: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2)"""
    end_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2), NaN for signs."""
    anchor_known: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    end_known: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    score: FloatArray = field(default_factory=lambda: np.zeros(0))
    sigma_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    sigma_along_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n,) NaN if unknown, and for signs."""
    detector: tuple[str, ...] = ()
    is_centroid: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(n,) whether the ``triangle_center`` is the centroid."""
    to_centroid_px: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n,) NaN if unknown."""
    processed: ProcessedImages | None = None
    """The images that ``semviz detect`` has processed; None if it never ran."""

    @classmethod
    def of(cls, rows: Sequence[Proposal], processed: ProcessedImages | None = None) -> "Proposals":
        """Return single proposals as arrays, in the same order."""
        no_end = (np.nan, np.nan)
        return cls(
            id=tuple(row.id for row in rows),
            frame_index=np.array([row.frame_index for row in rows], np.int64),
            is_right=np.array([row.side == "right" for row in rows], np.bool_),
            class_id=np.array([row.class_id for row in rows], np.int64),
            anchor_px=np.array([row.anchor_px for row in rows], np.float64).reshape(-1, 2),
            end_px=np.array([row.end_px or no_end for row in rows], np.float64).reshape(-1, 2),
            anchor_known=np.array([row.anchor_known for row in rows], np.bool_),
            end_known=np.array([row.end_known for row in rows], np.bool_),
            score=np.array([row.score for row in rows], np.float64),
            sigma_px=np.array([row.sigma_px for row in rows], np.float64),
            sigma_along_px=np.array([row.sigma_along_px or np.nan for row in rows], np.float64),
            detector=tuple(row.detector for row in rows),
            is_centroid=np.array([row.triangle_center == "centroid" for row in rows], np.bool_),
            to_centroid_px=np.array(
                [np.nan if row.to_centroid_px is None else row.to_centroid_px for row in rows],
                np.float64,
            ),
            processed=processed,
        )

    def __len__(self) -> int:
        return len(self.id)

    def __getitem__(self, row: int) -> Proposal:
        end_u, end_v = map(float, self.end_px[row])
        anchor_u, anchor_v = map(float, self.anchor_px[row])
        return Proposal(
            id=self.id[row],
            frame_index=int(self.frame_index[row]),
            side="right" if self.is_right[row] else "left",
            class_id=int(self.class_id[row]),
            anchor_px=(anchor_u, anchor_v),
            end_px=None if np.isnan(end_u) else (end_u, end_v),
            anchor_known=bool(self.anchor_known[row]),
            end_known=bool(self.end_known[row]),
            score=float(self.score[row]),
            sigma_px=float(self.sigma_px[row]),
            sigma_along_px=None if np.isnan(along := self.sigma_along_px[row]) else float(along),
            detector=self.detector[row],
            triangle_center="centroid" if self.is_centroid[row] else "box",
            to_centroid_px=None if np.isnan(sixth := self.to_centroid_px[row]) else float(sixth),
        )

    def rows(self) -> tuple[Proposal, ...]:
        """Return all proposals, in order."""
        return tuple(self[row] for row in range(len(self)))

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of frames with proposals, ascending."""
        return tuple(sorted(self._of_frame))

    def in_frame(self, frame_index: int, side: Side | None = None) -> tuple[Proposal, ...]:
        """Return the proposals in a frame, or in one image of it, best score first."""
        rows = (self[row] for row in self._of_frame.get(frame_index, ()))
        return tuple(row for row in rows if side is None or row.side == side)

    @cached_property
    def _of_frame(self) -> Mapping[int, IntArray]:
        """The rows of each frame, best score first."""
        if not len(self):
            return {}
        order = np.lexsort((-self.score, self.frame_index))
        frames, starts = np.unique(self.frame_index[order], return_index=True)
        parts = np.split(order, starts[1:])
        return dict(zip(map(int, frames), parts, strict=True))

    def joined(self, newer: "Proposals") -> "Proposals":
        """Return these proposals and ``newer``, which replace those with the same ids."""
        replaced = set(newer.id)
        kept = (row for row in self.rows() if row.id not in replaced)
        return Proposals.of([*kept, *newer.rows()], self.processed)

    def following(self, triangle_center: TriangleCenter) -> "Proposals":
        """Return all by one definition, as ``Proposal.following``."""
        return Proposals.of([row.following(triangle_center) for row in self.rows()], self.processed)

    def usable(self, triangle_center: TriangleCenter) -> "Proposals":
        """Return those that can follow a definition, by it."""
        fixed = (self.class_id == TRIANGULAR) & np.isnan(self.to_centroid_px)
        other = self.is_centroid != (triangle_center == "centroid")
        rows = [self[row] for row in np.flatnonzero(~(fixed & other)).tolist()]
        return Proposals.of(rows, self.processed).following(triangle_center)

    @property
    def triangle_center(self) -> TriangleCenter:
        """What all of them can follow: the box if a triangle there has no known height."""
        fixed = (self.class_id == TRIANGULAR) & np.isnan(self.to_centroid_px) & ~self.is_centroid
        return "box" if fixed.any() else NEW_CENTER

    @property
    def detections(self) -> tuple[Proposal, ...]:
        """The proposals of the detector that ``semviz detect`` ran; all if it never ran."""
        detector = None if self.processed is None else self.processed.detector
        return tuple(row for row in self.rows() if detector is None or row.detector == detector)


class _Row(BaseModel):
    """One proposal of a file."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, frozen=True)

    frame_index: Index
    side: Side
    class_name: Annotated[str, Field(alias="class")]
    anchor_px: Pixel
    score: Annotated[float, Field(ge=0, le=1)]
    end_px: Pixel | None = None
    anchor_known: bool = True
    end_known: bool = True
    sigma_px: Annotated[float, Field(gt=0, le=1000)] = SIGMA_PX
    sigma_along_px: Annotated[float, Field(gt=0, le=1000)] | None = None
    detector: Annotated[str, Field(max_length=100)] = ""
    id: Id | None = None
    triangle_center: TriangleCenter = OLDER_CENTER
    to_centroid_px: Annotated[float, Field(ge=-1e4, le=1e4)] | None = None


class _ProposalsFile(BaseModel):
    """A file of proposals."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: Literal["semviz-proposals"]
    version: Literal[1]
    proposals: Annotated[list[_Row], Field(max_length=MAX_PROPOSALS)]


_ROWS: TypeAdapter[list[_Row]] = TypeAdapter(list[_Row])


def read_proposals(
    path: Path,
    classes: ClassSet = DEFAULT_CLASSES,
    rig: Rig | None = None,
    frames: Collection[int] | None = None,
) -> Proposals:
    """Read a JSON or Parquet file of the format above.

    Points must be inside the images of ``rig``, frames among ``frames``; None accepts all. A
    proposal without an id gets one derived from its content. Raise SemvizError, naming file and
    item (from 1), if something is invalid.
    """
    rows = _parquet_rows(path) if _is_parquet(path) else _json_rows(path)
    proposals: list[Proposal] = []
    items: dict[str, int] = {}
    for item, row in enumerate(rows, 1):
        try:
            proposal = _proposal(row, classes, frames)
            first = items.setdefault(proposal.id, item)
            if first != item:
                raise SemvizError(f"duplicates item {first}, or has its id")
        except SemvizError as error:
            raise _refusal(path, item, error) from None
        proposals.append(proposal)
    result = Proposals.of(proposals)
    if rig is not None:
        _check_inside(path, result, rig)
    return result


def load_proposals(path: Path, classes: ClassSet = DEFAULT_CLASSES) -> Proposals:
    """Read the file of ``save_proposals``; return no proposals if there is none."""
    import pyarrow.parquet as pq

    if not path.exists():
        return Proposals()
    proposals = read_proposals(path, classes)
    if not _is_parquet(path):
        raise SemvizError(f"{path}: not a Parquet file; delete it, and detect again")
    text = (pq.read_schema(path).metadata or {}).get(PROCESSED_KEY.encode())
    if text is None:
        return proposals
    try:
        return replace(proposals, processed=ProcessedImages.from_json(text))
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}; delete it, and detect again") from None


def save_proposals(proposals: Proposals, path: Path, classes: ClassSet = DEFAULT_CLASSES) -> None:
    """Write a Parquet file of the format above, completely or not at all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = {class_.id: class_.name for class_ in classes}
    no_end = np.isnan(proposals.end_px[:, 0])
    columns: dict[str, Any] = {
        "id": pa.array(proposals.id, pa.string()),
        "frame_index": pa.array(proposals.frame_index),
        "side": pa.array(np.where(proposals.is_right, "right", "left").tolist(), pa.string()),
        "class": pa.array([names[int(class_id)] for class_id in proposals.class_id], pa.string()),
        "anchor_u": pa.array(proposals.anchor_px[:, 0]),
        "anchor_v": pa.array(proposals.anchor_px[:, 1]),
        "end_u": pa.array(proposals.end_px[:, 0], mask=no_end),
        "end_v": pa.array(proposals.end_px[:, 1], mask=no_end),
        "anchor_known": pa.array(proposals.anchor_known),
        "end_known": pa.array(proposals.end_known),
        "score": pa.array(proposals.score),
        "sigma_px": pa.array(proposals.sigma_px),
        "sigma_along_px": pa.array(
            proposals.sigma_along_px, mask=np.isnan(proposals.sigma_along_px)
        ),
        "detector": pa.array([name or None for name in proposals.detector], pa.string()),
    }
    measured = ~np.isnan(proposals.to_centroid_px)
    if measured.any() or proposals.is_centroid.any():
        columns["triangle_center"] = pa.array(
            ["centroid" if is_centroid else "box" for is_centroid in proposals.is_centroid]
        )
        columns["to_centroid_px"] = pa.array(proposals.to_centroid_px, mask=~measured)
    processed = proposals.processed
    metadata = {} if processed is None else {PROCESSED_KEY: processed.as_json()}
    table = pa.table(columns).replace_schema_metadata({FORMAT: str(VERSION)} | metadata)
    with replacing(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


def _is_parquet(path: Path) -> bool:
    check_file(path, MAX_BYTES)
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def _json_rows(path: Path) -> list[_Row]:
    try:
        return _ProposalsFile.model_validate_json(read_limited(path, MAX_BYTES)).proposals
    except ValidationError as error:
        raise _fault(path, error, 1) from None


_OPTIONAL = {
    "end_u", "end_v", "anchor_known", "end_known", "sigma_px", "sigma_along_px", "detector", "id",
    "triangle_center", "to_centroid_px",
}  # fmt: skip
_TEXTS = {"id", "side", "class", "detector", "triangle_center"}
_NEEDED = {"frame_index", "side", "class", "anchor_u", "anchor_v", "score"}


def _parquet_rows(path: Path) -> list[_Row]:
    import pyarrow as pa

    try:
        # dictionary encoding: repeated texts take no memory, however long they are
        file = open_parquet(path, MAX_UNPACKED_BYTES, MAX_PROPOSALS, tuple(_TEXTS))
        _check_columns(path, file)
        table = file.read()
        for name in _TEXTS & set(table.column_names):
            texts = table[name].unify_dictionaries().chunks
            if any(len(text) > 100 for chunk in texts[:1] for text in _values_of(chunk)):
                raise SemvizError(f"{path}: a {name} of more than 100 characters")
        rows = [_as_json(row) for row in table.to_pylist()]
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        raise SemvizError(f"{path}: not a readable Parquet file ({first_line(error)})") from None
    try:
        return _ROWS.validate_python(rows)
    except ValidationError as error:
        raise _fault(path, error, 0) from None


def _check_columns(path: Path, file: Any) -> None:
    """Raise SemvizError if a Parquet file has invalid columns or too many rows."""
    import pyarrow as pa

    names = set(file.schema_arrow.names)
    if missing := sorted(_NEEDED - names):
        raise SemvizError(f"{path}: no column {missing[0]!r}. Nothing was imported.")
    if unknown := sorted(names - _NEEDED - _OPTIONAL):
        raise SemvizError(f"{path}: unknown column {unknown[0]!r}. Nothing was imported.")
    if len(names) < len(file.schema_arrow.names):
        raise SemvizError(f"{path}: two columns of one name. Nothing was imported.")
    nested = [column.name for column in file.schema_arrow if pa.types.is_nested(column.type)]
    if nested:
        raise SemvizError(f"{path}: column {nested[0]!r} holds lists. Nothing was imported.")


def _values_of(chunk: Any) -> list[str]:
    return [text or "" for text in getattr(chunk, "dictionary", chunk).to_pylist()]


def _as_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of Parquet as a JSON object, without null values."""
    plain = {key: value for key, value in row.items() if value is not None}
    for point in ("anchor", "end"):
        parts = [plain.pop(f"{point}_{axis}", None) for axis in ("u", "v")]
        if parts != [None, None]:
            plain[f"{point}_px"] = tuple(parts)
    return plain


def _fault(path: Path, error: ValidationError, depth: int) -> SemvizError:
    """Return the first error with its item, whose index is at ``depth`` in the error's path."""
    fault = error.errors(include_url=False, include_input=False)[0]
    keys = list(fault["loc"])
    if len(keys) > depth and isinstance(keys[depth], int):
        item, names = int(keys[depth]), ".".join(map(str, keys[depth + 1 :]))
        return _refusal(path, item + 1, f"{names}: {fault['msg']}" if names else fault["msg"])
    where = ".".join(map(str, keys))
    why = f"{where}: {fault['msg']}" if where else fault["msg"]
    return SemvizError(f"{path}: not a file of proposals ({why}). Nothing was imported.")


def _refusal(path: Path, item: int, why: object) -> SemvizError:
    return SemvizError(f"{path}, item {item}: {why}. Nothing was imported.")


def _proposal(row: _Row, classes: ClassSet, frames: Collection[int] | None) -> Proposal:
    element_class = next((class_ for class_ in classes if class_.name == row.class_name), None)
    if element_class is None:
        known = ", ".join(class_.name for class_ in classes)
        raise SemvizError(f"unknown class {ascii(row.class_name)[:60]}; known are {known}")
    if frames is not None and row.frame_index not in frames:
        raise SemvizError(f"there is no frame {row.frame_index}")
    if (element_class.kind == "line") != (row.end_px is not None):
        needs = "needs anchor_px and end_px" if element_class.kind == "line" else "has no end_px"
        raise SemvizError(f"a {element_class.name} {needs}")
    if row.end_px is not None and (
        np.hypot(row.anchor_px[0] - row.end_px[0], row.anchor_px[1] - row.end_px[1]) < MIN_LENGTH_PX
    ):
        raise SemvizError("peak and bottom are the same point")
    if row.end_px is None and row.sigma_along_px is not None:
        raise SemvizError(f"a {element_class.name} has no sigma_along_px")
    return Proposal(
        id=row.id
        or proposal_content_id(
            row.frame_index, row.side, element_class.id, row.anchor_px, row.end_px
        ),
        frame_index=row.frame_index,
        side=row.side,
        class_id=element_class.id,
        anchor_px=row.anchor_px,
        end_px=row.end_px,
        anchor_known=row.anchor_known,
        end_known=row.end_known and row.end_px is not None,
        score=row.score,
        sigma_px=row.sigma_px,
        sigma_along_px=row.sigma_along_px,
        detector=row.detector,
        triangle_center=row.triangle_center,
        to_centroid_px=row.to_centroid_px,
    )


def _check_inside(path: Path, proposals: Proposals, rig: Rig) -> None:
    for is_right, camera in ((False, rig.left), (True, rig.right)):
        rows = np.flatnonzero(proposals.is_right == is_right)
        if not len(rows):
            continue
        if camera is None:
            raise _refusal(path, int(rows[0]) + 1, "this sequence has no right camera")
        for points in (proposals.anchor_px[rows], proposals.end_px[rows]):
            outside = ~camera.contains(points) & ~np.isnan(points[:, 0])
            if outside.any():
                first = int(np.flatnonzero(outside)[0])
                u, v = points[first]
                side = "right" if is_right else "left"
                size = f"{camera.width}x{camera.height}"
                raise _refusal(
                    path, int(rows[first]) + 1,
                    f"point ({u:.1f}, {v:.1f}) is outside the {side} image ({size})",
                )  # fmt: skip

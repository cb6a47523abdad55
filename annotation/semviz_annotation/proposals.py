"""What a detector proposes: poles and signs that a person may accept, each with a score.

They come in by one contract, as JSON or as Parquet, and are kept in the workspace as Parquet of
that same contract. Pixel (0, 0) is the centre of the top-left pixel, as everywhere here.

JSON is ``{"format": "semviz-proposals", "version": 1, "proposals": [...]}``, each proposal an
object of ``frame_index``, ``side``, ``class`` (a name), ``anchor_px`` [u, v] and ``score``, and
where there is more to say ``end_px`` (poles), ``anchor_known``, ``end_known``, ``sigma_px``,
``sigma_along_px``, ``detector``, ``id``. Parquet has the same as columns, points as ``anchor_u``,
``anchor_v``, ``end_u``, ``end_v``, null where there is none.

A workspace's file says beside them, in its metadata, which images ``semviz detect`` looked at.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from semviz_annotation.looked import Looked
from semviz_annotation.rows import Id, Index, derived_id
from semviz_annotation.rules import MIN_LENGTH_PX
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Rig
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.sources.source import Side

FORMAT = "semviz-proposals"
VERSION = 1
LOOKED = "semviz-detect"
"""Key of the metadata that ``Looked`` is kept under."""
SIGMA_PX = 2.0
"""Standard deviation of the points where a detector does not state it."""
MOST_BYTES = 256 * 2**20
MOST = 2_000_000
"""So many proposals are read from one file."""


@dataclass(frozen=True)
class Proposal:
    """One proposed pole or sign in one image."""

    id: str
    """That of the observation which it becomes when it is accepted."""
    frame_index: int
    side: Side
    class_id: int
    anchor_px: tuple[float, float]
    end_px: tuple[float, float] | None
    """None for signs."""
    anchor_known: bool
    end_known: bool
    """False for signs."""
    score: float
    """0..1; what it means is the detector's affair."""
    sigma_px: float
    """Of a sign's middle along each axis; across a pole, at its ends."""
    sigma_along_px: float | None = None
    """Along a pole, at its ends; None where nobody says, and for signs."""
    detector: str = ""
    """Name of what found it, if known."""


@dataclass(frozen=True, eq=False)
class Proposals:
    """All proposals of a workspace, as a struct of arrays; each array has one row a proposal."""

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
    """(n,) NaN where nobody says, and for signs."""
    detector: tuple[str, ...] = ()
    looked: Looked | None = None
    """What ``semviz detect`` did; None where it was never at work."""

    @classmethod
    def of(cls, rows: Sequence[Proposal], looked: Looked | None = None) -> "Proposals":
        """From single proposals, in their order."""
        nothing = (np.nan, np.nan)
        return cls(
            id=tuple(row.id for row in rows),
            frame_index=np.array([row.frame_index for row in rows], np.int64),
            is_right=np.array([row.side == "right" for row in rows], np.bool_),
            class_id=np.array([row.class_id for row in rows], np.int64),
            anchor_px=np.array([row.anchor_px for row in rows], np.float64).reshape(-1, 2),
            end_px=np.array([row.end_px or nothing for row in rows], np.float64).reshape(-1, 2),
            anchor_known=np.array([row.anchor_known for row in rows], np.bool_),
            end_known=np.array([row.end_known for row in rows], np.bool_),
            score=np.array([row.score for row in rows], np.float64),
            sigma_px=np.array([row.sigma_px for row in rows], np.float64),
            sigma_along_px=np.array([row.sigma_along_px or np.nan for row in rows], np.float64),
            detector=tuple(row.detector for row in rows),
            looked=looked,
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
        )

    def rows(self) -> tuple[Proposal, ...]:
        """One by one, in their order."""
        return tuple(self[row] for row in range(len(self)))

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of frames with proposals, ascending."""
        return tuple(sorted(self._of_frame))

    def in_frame(self, frame_index: int, side: Side | None = None) -> tuple[Proposal, ...]:
        """What is proposed for a frame (for one image of it), the best score first."""
        rows = (self[row] for row in self._of_frame.get(frame_index, ()))
        return tuple(row for row in rows if side is None or row.side == side)

    @cached_property
    def _of_frame(self) -> Mapping[int, IntArray]:
        """Rows of each frame, the best score first."""
        if not len(self):
            return {}
        order = np.lexsort((-self.score, self.frame_index))
        frames, starts = np.unique(self.frame_index[order], return_index=True)
        parts = np.split(order, starts[1:])
        return dict(zip(map(int, frames), parts, strict=True))

    def joined(self, newer: "Proposals") -> "Proposals":
        """These and ``newer``, which take the place of those with the same ids."""
        taken = set(newer.id)
        kept = (row for row in self.rows() if row.id not in taken)
        return Proposals.of([*kept, *newer.rows()], self.looked)

    @property
    def found(self) -> tuple[Proposal, ...]:
        """What ``semviz detect`` found; where it never looked, all that is proposed."""
        own = None if self.looked is None else self.looked.detector
        return tuple(row for row in self.rows() if own is None or row.detector == own)


_Pixel = tuple[float, float]


class _Row(BaseModel):
    """One proposal of a file."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, frozen=True)

    frame_index: Index
    side: Side
    class_name: Annotated[str, Field(alias="class")]
    anchor_px: _Pixel
    score: Annotated[float, Field(ge=0, le=1)]
    end_px: _Pixel | None = None
    anchor_known: bool = True
    end_known: bool = True
    sigma_px: Annotated[float, Field(gt=0, le=1000)] = SIGMA_PX
    sigma_along_px: Annotated[float, Field(gt=0, le=1000)] | None = None
    detector: Annotated[str, Field(max_length=100)] = ""
    id: Id | None = None


class _Document(BaseModel):
    """A file of proposals."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: Literal["semviz-proposals"]
    version: Literal[1]
    proposals: Annotated[list[_Row], Field(max_length=MOST)]


_ROWS: TypeAdapter[list[_Row]] = TypeAdapter(list[_Row])


def read_proposals(
    path: Path,
    classes: ClassSet = DEFAULT_CLASSES,
    rig: Rig | None = None,
    frames: Collection[int] | None = None,
) -> Proposals:
    """Proposals of a JSON or Parquet file of the contract above.

    ``rig`` gives the image sizes that points are checked against, ``frames`` are those there are;
    None accepts all. A proposal without an id gets one from what it says, always the same. Raises
    SemvizError naming file and item where something is wrong; items count from 1.
    """
    rows = _parquet_rows(path) if _is_parquet(path) else _json_rows(path)
    proposals: list[Proposal] = []
    items: dict[str, int] = {}
    for item, row in enumerate(rows, 1):
        try:
            one = _proposal(row, classes, frames)
            first = items.setdefault(one.id, item)
            if first != item:
                raise SemvizError(f"has the id of item {first}, or is the same")
        except SemvizError as error:
            raise _refusal(path, item, error) from None
        proposals.append(one)
    result = Proposals.of(proposals)
    if rig is not None:
        _check_inside(path, result, rig)
    return result


def load_proposals(path: Path, classes: ClassSet = DEFAULT_CLASSES) -> Proposals:
    """What ``save_proposals`` wrote; none where there is no file."""
    import pyarrow.parquet as pq

    if not path.exists():
        return Proposals()
    read = read_proposals(path, classes)
    told = (pq.read_schema(path).metadata or {}).get(LOOKED.encode())
    try:
        return read if told is None else replace(read, looked=Looked.from_json(told))
    except SemvizError as error:
        raise SemvizError(f"{path}: {error}; delete it, and detect again") from None


def save_proposals(proposals: Proposals, path: Path, classes: ClassSet = DEFAULT_CLASSES) -> None:
    """Write Parquet of the contract, whole or not at all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = {one.id: one.name for one in classes}
    ends = np.isnan(proposals.end_px[:, 0])
    columns: dict[str, Any] = {
        "id": pa.array(proposals.id, pa.string()),
        "frame_index": pa.array(proposals.frame_index),
        "side": pa.array(np.where(proposals.is_right, "right", "left").tolist(), pa.string()),
        "class": pa.array([names[int(one)] for one in proposals.class_id], pa.string()),
        "anchor_u": pa.array(proposals.anchor_px[:, 0]),
        "anchor_v": pa.array(proposals.anchor_px[:, 1]),
        "end_u": pa.array(proposals.end_px[:, 0], mask=ends),
        "end_v": pa.array(proposals.end_px[:, 1], mask=ends),
        "anchor_known": pa.array(proposals.anchor_known),
        "end_known": pa.array(proposals.end_known),
        "score": pa.array(proposals.score),
        "sigma_px": pa.array(proposals.sigma_px),
        "sigma_along_px": pa.array(
            proposals.sigma_along_px, mask=np.isnan(proposals.sigma_along_px)
        ),
        "detector": pa.array([name or None for name in proposals.detector], pa.string()),
    }
    looked = {} if proposals.looked is None else {LOOKED: proposals.looked.as_json()}
    table = pa.table(columns).replace_schema_metadata({FORMAT: str(VERSION)} | looked)
    with replacing(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def _is_parquet(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) == b"PAR1"
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None


def _json_rows(path: Path) -> list[_Row]:
    if path.stat().st_size > MOST_BYTES:
        raise SemvizError(f"{path}: more than {MOST_BYTES // 2**20} MB; split the file")
    try:
        return _Document.model_validate_json(path.read_bytes()).proposals
    except ValidationError as error:
        raise _fault(path, error, 1) from None


_OPTIONAL = {
    "end_u", "end_v", "anchor_known", "end_known", "sigma_px", "sigma_along_px", "detector", "id",
}  # fmt: skip
_TEXTS = {"id", "side", "class", "detector"}
_NEEDED = {"frame_index", "side", "class", "anchor_u", "anchor_v", "score"}


def _parquet_rows(path: Path) -> list[_Row]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
        _check_columns(path, file)
        # as dictionaries, texts that repeat take no room, however long somebody made them
        table = pq.read_table(path, read_dictionary=list(_TEXTS & set(file.schema_arrow.names)))
        for name in _TEXTS & set(table.column_names):
            texts = table[name].unify_dictionaries().chunks
            if any(len(text) > 100 for chunk in texts[:1] for text in _values_of(chunk)):
                raise SemvizError(f"{path}: a {name} of more than 100 characters")
        rows = [_as_json(row) for row in table.to_pylist()]
    except (pa.ArrowException, OSError, ValueError, TypeError) as error:
        why = (str(error).splitlines() or [""])[0]
        raise SemvizError(f"{path}: not a readable Parquet file ({why})") from None
    try:
        return _ROWS.validate_python(rows)
    except ValidationError as error:
        raise _fault(path, error, 0) from None


def _check_columns(path: Path, file: Any) -> None:
    """SemvizError where a Parquet file has other columns, or more than is reasonable."""
    import pyarrow as pa

    names = set(file.schema_arrow.names)
    if missing := sorted(_NEEDED - names):
        raise SemvizError(f"{path}: no column {missing[0]!r}. Nothing was imported.")
    if others := sorted(names - _NEEDED - _OPTIONAL):
        raise SemvizError(f"{path}: unknown column {others[0]!r}. Nothing was imported.")
    if len(names) < len(file.schema_arrow.names):
        raise SemvizError(f"{path}: two columns of one name. Nothing was imported.")
    nested = [one.name for one in file.schema_arrow if pa.types.is_nested(one.type)]
    if nested:
        raise SemvizError(f"{path}: column {nested[0]!r} holds lists. Nothing was imported.")
    if file.metadata.num_rows > MOST:
        raise SemvizError(f"{path}: more than {MOST} proposals; split the file")


def _values_of(chunk: Any) -> list[str]:
    return [text or "" for text in getattr(chunk, "dictionary", chunk).to_pylist()]


def _as_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of Parquet as an object of JSON; what is null is left out."""
    plain = {key: value for key, value in row.items() if value is not None}
    for point in ("anchor", "end"):
        parts = [plain.pop(f"{point}_{axis}", None) for axis in ("u", "v")]
        if parts != [None, None]:
            plain[f"{point}_px"] = tuple(parts)
    return plain


def _fault(path: Path, error: ValidationError, depth: int) -> SemvizError:
    """The first thing that is wrong, with the item (``depth`` deep in its place) where it is."""
    fault = error.errors(include_url=False, include_input=False)[0]
    place = list(fault["loc"])
    if len(place) > depth and isinstance(place[depth], int):
        item, names = int(place[depth]), ".".join(map(str, place[depth + 1 :]))
        return _refusal(path, item + 1, f"{names}: {fault['msg']}" if names else fault["msg"])
    where = ".".join(map(str, place))
    why = f"{where}: {fault['msg']}" if where else fault["msg"]
    return SemvizError(f"{path}: no proposals ({why}). Nothing was imported.")


def _refusal(path: Path, item: int, why: object) -> SemvizError:
    return SemvizError(f"{path}, item {item}: {why}. Nothing was imported.")


def _proposal(row: _Row, classes: ClassSet, frames: Collection[int] | None) -> Proposal:
    one = next((one for one in classes if one.name == row.class_name), None)
    if one is None:
        known = ", ".join(one.name for one in classes)
        raise SemvizError(f"unknown class {ascii(row.class_name)[:60]}; known are {known}")
    if frames is not None and row.frame_index not in frames:
        raise SemvizError(f"there is no frame {row.frame_index}")
    if (one.kind == "line") != (row.end_px is not None):
        needs = "needs anchor_px and end_px" if one.kind == "line" else "has no end_px"
        raise SemvizError(f"a {one.name} {needs}")
    if row.end_px is not None and (
        np.hypot(row.anchor_px[0] - row.end_px[0], row.anchor_px[1] - row.end_px[1]) < MIN_LENGTH_PX
    ):
        raise SemvizError("peak and bottom are the same point")
    if row.end_px is None and row.sigma_along_px is not None:
        raise SemvizError(f"a {one.name} has no sigma_along_px")
    return Proposal(
        id=row.id or id_of(row.frame_index, row.side, one.id, row.anchor_px, row.end_px),
        frame_index=row.frame_index,
        side=row.side,
        class_id=one.id,
        anchor_px=row.anchor_px,
        end_px=row.end_px,
        anchor_known=row.anchor_known,
        end_known=row.end_known and row.end_px is not None,
        score=row.score,
        sigma_px=row.sigma_px,
        sigma_along_px=row.sigma_along_px,
        detector=row.detector,
    )


def id_of(
    frame_index: int, side: Side, class_id: int, anchor_px: _Pixel, end_px: _Pixel | None
) -> str:
    """The id that follows from what is proposed where."""
    return derived_id(f"proposal {(frame_index, side, class_id, anchor_px, end_px)!r}")


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

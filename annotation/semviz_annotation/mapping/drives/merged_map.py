"""The map of several drives, and what became of the maps that it is made of."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from semviz_annotation.mapping.drives.merge import DEFAULT_OPTIONS, MergeOptions, Merging, Stack
from semviz_annotation.mapping.drives.regions import merge_elements
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress, unwatched
from semviz_core.datasets.own_drive.poses.conventions import map_on_earth

_STILL_M = 0.001
_TOO_LARGE = 1.25
"""Errors of poses beyond so many times the stated ones are said."""


@dataclass(frozen=True)
class DriveReport:
    """What became of the map of one drive."""

    name: str
    elements: int
    shared: int
    """Elements that other drives have mapped, too."""
    moved_m: float
    """RMS shift of its elements on the ground."""
    most_moved_m: float
    turned_deg: float
    """RMS turn of its stretches."""

    def __str__(self) -> str:
        if not self.shared:
            return (
                f"{self.name}: {self.elements} elements, none of them in another drive: not moved"
            )
        return (
            f"{self.name}: {self.elements} elements, {self.shared} of them in other drives; moved "
            f"by {self.moved_m:.2f} m, at most {self.most_moved_m:.2f} m, turned by "
            f"{self.turned_deg:.2f} deg"
        )


@dataclass(frozen=True)
class MergeReport:
    """What became of the maps."""

    drives: tuple[DriveReport, ...]
    elements: int
    """Landmarks of the merged map."""
    shared: int
    """Those that several drives have mapped."""
    sigma_m: float
    """Stated error of poses."""

    @property
    def found_sigma_m(self) -> float:
        """The error of poses, in each direction, by how far drives were moved, if any were."""
        moved_m = [drive.moved_m for drive in self.drives if drive.moved_m > _STILL_M]
        return _rms(np.array(moved_m or [0.0])) / float(np.sqrt(2.0))

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "drives": [asdict(drive) for drive in self.drives]}

    def lines(self) -> Iterator[str]:
        """Yield lines for people."""
        yield from map(str, self.drives)
        yield f"{self.elements} landmarks, {self.shared} of them mapped by several drives"
        if self.found_sigma_m > _TOO_LARGE * self.sigma_m:
            yield (
                f"poses seem to be off by {self.found_sigma_m:.2f} m, more than the stated "
                f"{self.sigma_m:g} m, so landmarks may stand in the map twice: use --pose-sigma-m "
                f"{self.found_sigma_m:.1g}"
            )


class MergedDrives(NamedTuple):
    """One map of several drives."""

    semantic_map: SemanticMap
    report: MergeReport
    merging: Merging


def merge_maps(
    maps: Mapping[str, SemanticMap],
    options: MergeOptions = DEFAULT_OPTIONS,
    on_progress: OnProgress = unwatched,
) -> MergedDrives:
    """Return the map of all drives, in the frame of the first one, and what was merged.

    Landmarks of the first map keep their ids; others get the numbers after these, in the order of
    maps and ids. Covariances are relative to the neighbours: errors that a stretch shares are not
    in them. Raise SemvizError for maps whose frames, classes or centres of triangles differ.
    """
    names = list(maps)
    given = _alike(maps)
    merging = merge_elements(given, options, on_progress)
    return MergedDrives(_merged(given, merging), _report(names, merging, options), merging)


def in_frame(semantic_map: SemanticMap, frame: MapFrame, name: str) -> SemanticMap:
    """Return a map, which errors call ``name``, in another frame, by the places of both on earth.
    Raise SemvizError if the frames differ and these are not known."""
    own = semantic_map.frame
    if own == frame or (own.name == frame.name and None in (own.origin, frame.origin)):
        return semantic_map
    if own.origin is None or frame.origin is None:
        raise SemvizError(
            f"{name}: is in the frame {own.name}, not in {frame.name}; give both a georeference, "
            "or build them from drives with poses in one frame"
        )
    T_own_earth = map_on_earth(own.origin, own.x_heading_deg)
    T_frame_own = map_on_earth(frame.origin, frame.x_heading_deg) @ T_own_earth.inverse()
    return replace(
        semantic_map,
        elements=semantic_map.elements.transformed(T_frame_own),
        trajectory_m=T_frame_own.apply(semantic_map.trajectory_m),
        frame=frame,
    )


def _alike(maps: Mapping[str, SemanticMap]) -> list[SemanticMap]:
    """Return the maps in the frame of the first. Raise SemvizError for what cannot be merged."""
    first_name, first = next(iter(maps.items()))
    for name, one in maps.items():
        if not len(one):
            raise SemvizError(f"{name}: the map has no element; leave it out")
        if one.classes != first.classes:
            raise SemvizError(f"{name}: has other classes than {first_name}; leave one out")
        if one.triangle_center != first.triangle_center:
            raise SemvizError(
                f"{name}: the centre of triangular signs is another than in {first_name}; build "
                "one of the maps again"
            )
    return [in_frame(one, first.frame, name) for name, one in maps.items()]


def _merged(maps: Sequence[SemanticMap], merging: Merging) -> SemanticMap:
    """Return the landmarks as a map in the frame of the first, sorted by id."""
    stack, first = merging.stack, maps[0]
    members = _members_of(merging.landmark)
    ids = _ids(stack, members)
    order = np.argsort(ids)
    members, ids = [members[row] for row in order.tolist()], ids[order]
    return SemanticMap(
        elements=_elements(merging, members, ids, order),
        frame=first.frame,
        classes=first.classes,
        trajectory_m=_ways(maps, merging),
        provenance=_provenance(maps, members, stack) if any(one.provenance for one in maps) else (),
        made_by=f"semviz {version('semviz')}, {len(maps)} drives",
        triangle_center=first.triangle_center,
        attributes=_attributes(maps, members, ids, stack),
    )


def _members_of(landmark: IntArray) -> list[IntArray]:
    """Return the elements of each landmark, ascending."""
    ends = np.cumsum(np.bincount(landmark))
    return np.split(np.argsort(landmark, kind="stable"), ends[:-1])


def _ids(stack: Stack, members: Sequence[IntArray]) -> IntArray:
    """Return the ids (l,) of landmarks: those of the first map, then new ones."""
    lead = np.array([rows[0] for rows in members], np.int64)
    old = stack.drive[lead] == 0
    ids = np.where(old, stack.id[lead], 0)
    ids[~old] = stack.id[stack.drive == 0].max() + 1 + np.arange(int((~old).sum()))
    return ids


def _elements(
    merging: Merging, members: Sequence[IntArray], ids: IntArray, order: IntArray
) -> Elements3D:
    stack, alignment = merging.stack, merging.alignment
    lead = np.array([rows[0] for rows in members], np.int64)
    known = np.stack([stack.known[rows].any(axis=0) for rows in members])
    ends_m = alignment.landmark_m[order].copy()
    covariance_m2 = alignment.covariance_m2[order].copy()
    point = ~stack.is_line[lead]
    ends_m[point, 3:] = np.nan
    covariance_m2[point, 3:] = 0.0
    covariance_m2[point, :, 3:] = 0.0
    return Elements3D(
        id=ids,
        anchor_m=ends_m[:, :3],
        end_m=ends_m[:, 3:],
        class_id=stack.kind[lead],
        covariance_m2=covariance_m2,
        anchor_known=known[:, 0],
        end_known=known[:, 1],
    )


def _provenance(
    maps: Sequence[SemanticMap], members: Sequence[IntArray], stack: Stack
) -> tuple[Provenance, ...]:
    """Return what each landmark was made from, in all drives. One that nobody vouches for is as
    sure as in the drive that is surest."""
    parts = [one.provenance or (Provenance(),) * len(one) for one in maps]
    every = [origin for part in parts for origin in part]
    return tuple(_joined([every[row] for row in rows.tolist()]) for rows in members)


def _attributes(
    maps: Sequence[SemanticMap], members: Sequence[IntArray], ids: IntArray, stack: Stack
) -> dict[int, dict[str, str]]:
    """Return what is known of landmarks; of two values, the one of the earlier map."""
    found: dict[int, dict[str, str]] = {}
    for id_, rows in zip(ids.tolist(), members, strict=True):
        for row in reversed(rows.tolist()):
            own = maps[stack.drive[row]].attributes.get(int(stack.id[row]))
            if own:
                found[id_] = found.get(id_, {}) | dict(own)
    return found


def _joined(origins: Sequence[Provenance]) -> Provenance:
    odds = [origin.log_odds for origin in origins if origin.log_odds is not None]
    return Provenance(
        tuple(id_ for origin in origins for id_ in origin.label_ids),
        tuple(id_ for origin in origins for id_ in origin.observation_ids),
        max(odds) if len(odds) == len(origins) else None,
    )


def _ways(maps: Sequence[SemanticMap], merging: Merging) -> FloatArray:
    """Return the corrected ways (p, 3) of all drives, one after the other."""
    way_m = np.concatenate([one.trajectory_m for one in maps])
    drive = np.repeat(np.arange(len(maps)), [len(one.trajectory_m) for one in maps])
    return way_m + merging.moves(np.hstack([way_m, way_m]), drive)[:, :3]


def _report(names: Sequence[str], merging: Merging, options: MergeOptions) -> MergeReport:
    stack, knots = merging.stack, merging.knots
    passes = np.bincount(merging.landmark)
    moved_m = np.linalg.norm(merging.moves(stack.ends_m, stack.drive)[:, :2], axis=1)
    turned_deg = np.rad2deg(merging.alignment.correction[:, 3])
    is_shared = (passes > 1)[merging.landmark]
    drives = [
        DriveReport(
            name,
            elements=rows.stop - rows.start,
            shared=int(is_shared[rows].sum()),
            moved_m=_rms(moved_m[rows]),
            most_moved_m=float(moved_m[rows].max()),
            turned_deg=_rms(turned_deg[own_knots]),
        )
        for name, rows, own_knots in zip(
            names, _rows_of(stack.drive), _rows_of(knots.drive), strict=True
        )
    ]
    return MergeReport(tuple(drives), len(passes), int((passes > 1).sum()), options.errors.sigma_m)


def _rows_of(drive: IntArray) -> list[slice]:
    """Return the rows of each drive (n,), which ascend from 0."""
    ends = np.cumsum(np.bincount(drive)).tolist()
    return [slice(start, end) for start, end in pairwise([0, *ends])]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))

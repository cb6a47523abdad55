"""Labels to a map, as in the paper (section III-A): stereo triangulation, true poses, DBSCAN.

Three rules go beyond the paper: observations that the annotator gave to one label element are never
torn apart, label elements seen together in one image are never merged, and an element without a
pair that tells its place is placed by the motion between its frames.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import combinations

import numpy as np

from semviz_annotation.labels import LabelElement, Labels, Observation
from semviz_annotation.mapping.fuse import Sighting, Thing, fuse
from semviz_annotation.mapping.motion import place_by_motion
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose
from semviz_core.semantic_map import Provenance, SemanticMap
from semviz_core.sources.source import Side, Source


@dataclass(frozen=True)
class BuildOptions:
    """How labels become a map."""

    eps_m: float = 1.0
    """DBSCAN's radius. Ten stereo pairs of one thing, fused, are good to about 0.1 m (simulated
    clicks of 1 px in KITTI's geometry), so 1 m is well above two estimates of one thing. Single far
    pairs scatter by metres: they need the annotator's identity, not a larger radius."""
    min_points: int = 1
    """DBSCAN's core size, in frames. What a person drew is no noise, so 1; labels from a detector
    want 2 or 3."""
    sigma_px: float = 1.0
    """How well labels are placed."""
    min_angle_deg: float = 0.5
    """Pairs under this ray angle are left out: 62 m with KITTI's baseline, where 1 px is 10 m.
    An element with no other pairs, or none at all, is placed by the motion between its frames,
    if that gives this angle."""

    def __post_init__(self) -> None:
        for name in ("eps_m", "min_points", "sigma_px", "min_angle_deg"):
            if not getattr(self, name) > 0:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True)
class Rejection:
    """A label element that is not in the map, or one of its pairs, and why."""

    name: str
    reason: str
    frame_index: int | None = None
    """The pair's frame; None for the whole element."""

    def __str__(self) -> str:
        where = "" if self.frame_index is None else f" in frame {self.frame_index}"
        return f"{self.name}{where}: {self.reason}"


@dataclass(frozen=True)
class BuildReport:
    """What became of the labels."""

    pairs: int
    """Stereo pairs that were triangulated."""
    by_motion: int
    """Label elements that were placed by the motion between their frames."""
    merged: tuple[tuple[str, ...], ...]
    """Names of label elements that became one map element, two or more each."""
    kept_apart: tuple[tuple[str, str], ...]
    """Near each other and of one class, but seen together in an image."""
    rejected: tuple[Rejection, ...]

    def __str__(self) -> str:
        """A line for each element that was rejected or merged."""
        by_name: dict[str, list[Rejection]] = {}
        for one in self.rejected:
            by_name.setdefault(one.name, []).append(one)
        moved = f", {self.by_motion} elements placed by motion" if self.by_motion else ""
        lines = [f"{self.pairs} stereo pairs triangulated{moved}, {len(self.rejected)} left out"]
        for name in sorted(by_name):
            first, *more = by_name[name]
            lines.append(f"left out: {first}" + (f" (and {len(more)} more)" if more else ""))
        lines += [f"merged: {', '.join(names)}" for names in self.merged]
        lines += [
            f"kept apart: {one} and {two} are seen in the same image"
            for one, two in self.kept_apart
        ]
        return "\n".join(lines)


@dataclass
class _Notes:
    """The report as it grows."""

    classes: ClassSet
    merged: list[tuple[str, ...]] = field(default_factory=list)
    kept_apart: list[tuple[str, str]] = field(default_factory=list)
    rejected: list[Rejection] = field(default_factory=list)

    def name(self, element: LabelElement) -> str:
        return self.classes.element_name(element.class_id, element.number)

    def reject(self, element: LabelElement, reason: str, frame_index: int | None = None) -> None:
        self.rejected.append(Rejection(self.name(element), reason, frame_index))


def build_map(
    labels: Labels,
    source: Source,
    options: BuildOptions = BuildOptions(),
    frames: Collection[int] | None = None,
    classes: ClassSet = DEFAULT_CLASSES,
) -> tuple[SemanticMap, BuildReport]:
    """A map of what is labelled in two or more images of ``frames`` (None: all), and what became
    of the labels.

    Raises SemvizError where a labelled frame is not in the source or has no pose, or nothing is
    labelled twice.
    """
    notes = _Notes(classes)
    posed = _posed_frames(labels, source, frames)
    sightings = list(_triangulate(_seen(labels, source, posed), options, notes))
    alone = [fuse(group, options.sigma_px) for group in _by_element(sightings)]
    things = [
        fuse([one for thing in group for one in thing.sightings], options.sigma_px)
        for group in _merge(alone, labels, options, notes)
    ]
    if not things:
        raise SemvizError(f"nothing could be triangulated; the first of all: {notes.rejected[0]}")
    by_motion = sum(one.by_motion for one in sightings)
    report = BuildReport(
        pairs=len(sightings) - by_motion,
        by_motion=by_motion,
        merged=tuple(notes.merged),
        kept_apart=tuple(notes.kept_apart),
        rejected=tuple(notes.rejected),
    )
    return _assemble(things, labels, source, posed, options, classes), report


def _posed_frames(
    labels: Labels, source: Source, frames: Collection[int] | None
) -> dict[int, Pose]:
    """``T_map_camera`` of the chosen frames that have one, by index."""
    poses = {frame.index: frame.T_map_camera for frame in source.frames}
    chosen = set(poses) if frames is None else set(frames)
    labelled = [index for index in labels.frames if index in chosen]
    for index in labels.frames if frames is None else labelled:
        if index not in poses:
            raise SemvizError(f"frame {index} is labelled but not in this sequence; wrong source?")
        if poses[index] is None:
            raise SemvizError(f"frame {index} is labelled but has no pose; a map needs true poses")
    views = Counter(row.element_id for index in labelled for row in labels.in_frame(index))
    if max(views.values(), default=0) < 2:
        raise SemvizError(
            "no element is labelled in two images; in 'semviz annotate', label elements in left "
            "and right, or in several frames"
        )
    return {index: pose for index, pose in poses.items() if index in chosen and pose is not None}


@dataclass(frozen=True, eq=False)
class _Seen:
    """An element in the chosen frames, not yet triangulated: its views in the map frame."""

    element: LabelElement
    views: tuple[View, ...]
    observations: tuple[Observation, ...]

    def pairs(self) -> Iterator["_Seen"]:
        """The stereo pairs in it, frame by frame."""
        frames: dict[int, list[int]] = {}
        for place, row in enumerate(self.observations):
            frames.setdefault(row.frame_index, []).append(place)
        for _, places in sorted(frames.items()):
            if len(places) == 2:
                yield self._only(places)

    def outside(self, frames: Collection[int]) -> "_Seen":
        """It without the views in some frames."""
        rows = enumerate(self.observations)
        return self._only([place for place, row in rows if row.frame_index not in frames])

    def _only(self, places: Sequence[int]) -> "_Seen":
        return _Seen(
            self.element,
            tuple(self.views[place] for place in places),
            tuple(self.observations[place] for place in places),
        )


def _seen(labels: Labels, source: Source, posed: dict[int, Pose]) -> Iterator[_Seen]:
    """Every element that is labelled in the frames ``posed`` (``T_map_camera``), by number."""
    sides: tuple[Side, ...] = ("left", "right") if source.rig.right is not None else ("left",)
    views = {
        (index, side): rig_view(source.rig, side, pose.inverse())
        for index, pose in posed.items()
        for side in sides
    }
    elements = {row.element_id for index in posed for row in labels.in_frame(index)}
    for element in sorted(map(labels.element, elements), key=lambda one: one.number):
        rows = labels.of_element(element.id)
        chosen = sorted(
            (row for row in rows if row.frame_index in posed),
            key=lambda row: (row.frame_index, row.side),
        )
        where = tuple(views[row.frame_index, row.side] for row in chosen)
        yield _Seen(element, where, tuple(chosen))


def _triangulate(
    elements: Iterable[_Seen], options: BuildOptions, notes: _Notes
) -> Iterator[Sighting]:
    """Each element's pairs one by one; where they do not tell its place, by all its views."""
    angle = float(np.deg2rad(options.min_angle_deg))
    for seen in elements:
        failed: list[tuple[int, Failed]] = []
        placed = False
        for pair in seen.pairs():
            result = triangulate(pair.views, pair.observations, options.sigma_px, angle)
            if isinstance(result, Failed):
                failed.append((pair.observations[0].frame_index, result))
                continue
            placed = True
            yield Sighting(seen.element, pair.views, pair.observations, result)
        if not placed:
            wrong = {index for index, failure in failed if not failure.too_narrow}
            rest = seen.outside(wrong)
            moved = _by_motion(rest, options.sigma_px, angle)
            if not isinstance(moved, Failed):
                yield Sighting(seen.element, rest.views, rest.observations, moved)
                failed = [one for one in failed if one[0] in wrong]
            elif not failed:
                notes.reject(seen.element, moved.reason)
        for frame_index, failure in failed:
            notes.reject(seen.element, failure.reason, frame_index)


def _by_motion(seen: _Seen, sigma_px: float, min_angle_rad: float) -> Triangulated | Failed:
    if len(seen.views) < 2:
        return Failed("labelled in one image only")
    return place_by_motion(seen.views, seen.observations, sigma_px, min_angle_rad)


def _by_element(sightings: Iterable[Sighting]) -> list[list[Sighting]]:
    """Together what the annotator gave to one label element; by number."""
    groups: dict[int, list[Sighting]] = {}
    for one in sightings:
        groups.setdefault(one.element.number, []).append(one)
    return [groups[number] for number in sorted(groups)]


def _merge(
    things: Sequence[Thing], labels: Labels, options: BuildOptions, notes: _Notes
) -> list[list[Thing]]:
    """Things of one class and place, together; nothing twice, noise left out."""
    groups: list[list[Thing]] = []
    for class_id in sorted({thing.elements[0].class_id for thing in things}):
        alike = [thing for thing in things if thing.elements[0].class_id == class_id]
        cluster = _dbscan(alike, options)
        for number in np.unique(cluster):
            members = [alike[row] for row in np.flatnonzero(cluster == number)]
            if number >= 0:
                groups += _split_covisible(members, labels, options, notes)
                continue
            for one in members:
                few = f"seen in fewer than {options.min_points} frames within {options.eps_m} m"
                notes.reject(one.elements[0], few)
    notes.merged += [
        tuple(notes.name(thing.elements[0]) for thing in group)
        for group in groups
        if len(group) > 1
    ]
    return groups


def _dbscan(things: Sequence[Thing], options: BuildOptions) -> IntArray:
    """(n,) cluster of each thing, -1 for noise. Each counts as many points as it has frames."""
    import open3d

    counts = [len({row.frame_index for row in thing.observations}) for thing in things]
    positions = np.repeat([_position(thing) for thing in things], counts, axis=0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(positions))
    clusters = np.asarray(cloud.cluster_dbscan(options.eps_m, options.min_points), dtype=np.int64)
    return np.asarray(clusters[np.cumsum(counts) - 1])


def _position(thing: Thing) -> FloatArray:
    """(3,) where a sign is; where a pole stands, since the heights of its ends may be unseen."""
    if np.isnan(thing.end_m).any():
        return thing.anchor_m
    return np.append((thing.anchor_m + thing.end_m)[:2] / 2.0, 0.0)


def _split_covisible(
    members: Sequence[Thing], labels: Labels, options: BuildOptions, notes: _Notes
) -> list[list[Thing]]:
    """Merge what is within reach, nearest first, unless one image shows both."""
    positions = [_position(one) for one in members]
    near = sorted(
        (distance, i, j)
        for i, j in combinations(range(len(members)), 2)
        if (distance := float(np.linalg.norm(positions[i] - positions[j]))) <= options.eps_m
    )
    group = {row: [row] for row in range(len(members))}
    images = {row: _images(one, labels) for row, one in enumerate(members)}
    for _, i, j in near:
        a, b = group[i], group[j]
        if a is b:
            continue
        if images[a[0]] & images[b[0]]:
            notes.kept_apart.append(
                (notes.name(members[i].elements[0]), notes.name(members[j].elements[0]))
            )
            continue
        a_images = images[a[0]] | images[b[0]]
        a += b
        images[a[0]] = a_images
        for row in b:
            group[row] = a
    distinct = {id(rows): rows for rows in group.values()}
    return [[members[row] for row in rows] for rows in distinct.values()]


def _images(thing: Thing, labels: Labels) -> set[tuple[int, str]]:
    return {
        (row.frame_index, row.side)
        for element in thing.elements
        for row in labels.of_element(element.id)
    }


def _assemble(
    things: Sequence[Thing],
    labels: Labels,
    source: Source,
    posed: dict[int, Pose],
    options: BuildOptions,
    classes: ClassSet,
) -> SemanticMap:
    things = sorted(things, key=lambda thing: thing.elements[0].number)
    elements = Elements3D(
        id=np.array([thing.elements[0].number for thing in things], dtype=np.int64),
        anchor_m=np.array([thing.anchor_m for thing in things]),
        end_m=np.array([thing.end_m for thing in things]),
        class_id=np.array([thing.elements[0].class_id for thing in things], dtype=np.int64),
        covariance_m2=np.array([thing.covariance_m2 for thing in things]),
        anchor_known=np.array([thing.anchor_known for thing in things]),
        end_known=np.array([thing.end_known for thing in things]),
    )
    return SemanticMap(
        elements=elements,
        frame=source.map_frame,
        classes=classes,
        trajectory_m=np.array([pose.translation for pose in posed.values()]),
        provenance=tuple(_provenance(thing) for thing in things),
        made_by=f"semviz {version('semviz')}: triangulation ({options.sigma_px} px), "
        f"DBSCAN ({options.eps_m} m, {options.min_points} points)",
        operation=labels.operation,
    )


def _provenance(thing: Thing) -> Provenance:
    return Provenance(
        label_ids=tuple(element.id for element in thing.elements),
        observation_ids=tuple(row.id for row in thing.observations),
    )

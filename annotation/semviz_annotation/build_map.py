"""Labels to a map, as in the paper (section III-A): stereo triangulation, true poses, DBSCAN.

Two rules go beyond the paper: observations that the annotator gave to one label element are never
torn apart, and label elements seen together in one image are never merged.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import combinations

import numpy as np

from semviz_annotation.fuse import Sighting, Thing, fuse
from semviz_annotation.labels import LabelElement, Labels, Observation
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose
from semviz_core.semantic_map import Provenance, SemanticMap
from semviz_core.sources.source import Source


@dataclass(frozen=True)
class BuildOptions:
    """How labels become a map."""

    eps_m: float = 1.0
    """DBSCAN's radius. Ten stereo pairs of one thing, fused, are good to about 0.1 m (simulated
    clicks of 1 px in KITTI's geometry), so 1 m is well above two estimates of one thing. Single far
    pairs scatter by metres: they need the annotator's identity, not a larger radius."""
    min_points: int = 1
    """DBSCAN's core size, in stereo pairs. A pair that a person drew is no noise, so 1; labels from
    a detector want 2 or 3."""
    sigma_px: float = 1.0
    """How well labels are placed."""
    min_angle_deg: float = 0.5
    """Pairs under this ray angle are left out: 62 m with KITTI's baseline, where 1 px is 10 m.
    An element with no other pairs is placed by the motion between its frames."""

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
        lines = [f"{self.pairs} stereo pairs triangulated, {len(self.rejected)} left out"]
        for name in sorted(by_name):
            first, *more = by_name[name]
            lines.append(f"left out: {first}" + (f" (and {len(more)} more pairs)" if more else ""))
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
    """A map of what is labelled in both images of ``frames`` (None: all), and what became of it.

    Raises SemvizError where a labelled frame is not in the source or has no pose, or nothing is
    labelled in both images.
    """
    notes = _Notes(classes)
    posed = _posed_frames(labels, source, frames)
    sightings = list(_triangulate(_pairs(labels, source, posed), options, notes))
    _note_unpaired(labels, posed, notes)
    alone = [fuse(group, options.sigma_px) for group in _by_element(sightings)]
    things = [
        fuse([one for thing in group for one in thing.sightings], options.sigma_px)
        for group in _merge(alone, labels, options, notes)
    ]
    if not things:
        raise SemvizError(f"nothing could be triangulated; the first of all: {notes.rejected[0]}")
    report = BuildReport(
        pairs=len(sightings),
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
    if not any(True for index in labelled for _ in labels.pairs(index)):
        raise SemvizError(
            "no element is labelled in both images of a frame; label partners in 'semviz annotate'"
        )
    return {index: pose for index, pose in poses.items() if index in chosen and pose is not None}


@dataclass(frozen=True, eq=False)
class _Seen:
    """An element in several views, not yet triangulated."""

    element: LabelElement
    views: tuple[View, ...]
    observations: tuple[Observation, ...]


def _pairs(labels: Labels, source: Source, posed: dict[int, Pose]) -> Iterator[_Seen]:
    """Every element of every stereo pair, its views in the map frame by the true pose."""
    for index, T_map_camera in posed.items():
        T_left_map = T_map_camera.inverse()
        left_view = rig_view(source.rig, "left", T_left_map)
        right_view = rig_view(source.rig, "right", T_left_map)
        for element, left, right in labels.pairs(index):
            yield _Seen(element, (left_view, right_view), (left, right))


def _triangulate(
    pairs: Iterable[_Seen], options: BuildOptions, notes: _Notes
) -> Iterator[Sighting]:
    """The pairs one by one; those of an element that is too far for each of its pairs, together."""
    placed: set[LabelElement] = set()
    failed: dict[LabelElement, list[tuple[_Seen, Failed]]] = {}
    for pair in pairs:
        result = _place(pair, options)
        if isinstance(result, Failed):
            failed.setdefault(pair.element, []).append((pair, result))
        else:
            placed.add(pair.element)
            yield Sighting(pair.element, pair.views, pair.observations, result)
    for element, tries in failed.items():
        far = [seen for seen, failure in tries if failure.too_narrow]
        if element not in placed and far:
            together = _together(far)
            result = _place(together, options)
            if not isinstance(result, Failed):
                yield Sighting(element, together.views, together.observations, result)
                continue
        for seen, failure in tries:
            notes.reject(element, failure.reason, seen.observations[0].frame_index)


def _place(seen: _Seen, options: BuildOptions) -> Triangulated | Failed:
    angle = float(np.deg2rad(options.min_angle_deg))
    return triangulate(seen.views, seen.observations, options.sigma_px, angle)


def _together(pairs: Sequence[_Seen]) -> _Seen:
    return _Seen(
        pairs[0].element,
        tuple(view for pair in pairs for view in pair.views),
        tuple(row for pair in pairs for row in pair.observations),
    )


def _note_unpaired(labels: Labels, posed: dict[int, Pose], notes: _Notes) -> None:
    seen = {row.element_id for index in posed for row in labels.in_frame(index)}
    paired = {pair.element.id for index in posed for pair in labels.pairs(index)}
    unpaired = (labels.element(element_id) for element_id in seen - paired)
    for element in sorted(unpaired, key=lambda one: one.number):
        notes.reject(element, "never labelled in both images of a frame")


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
                few = f"fewer than {options.min_points} stereo pairs within {options.eps_m} m"
                notes.reject(one.elements[0], few)
    notes.merged += [
        tuple(notes.name(thing.elements[0]) for thing in group)
        for group in groups
        if len(group) > 1
    ]
    return groups


def _dbscan(things: Sequence[Thing], options: BuildOptions) -> IntArray:
    """(n,) cluster of each thing, -1 for noise. Each counts as many points as it has pairs."""
    import open3d

    counts = [len(thing.sightings) for thing in things]
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
        made_by=f"semviz {version('semviz')}: stereo triangulation ({options.sigma_px} px), "
        f"DBSCAN ({options.eps_m} m, {options.min_points} points)",
        operation=labels.operation,
    )


def _provenance(thing: Thing) -> Provenance:
    return Provenance(
        label_ids=tuple(element.id for element in thing.elements),
        observation_ids=tuple(row.id for one in thing.sightings for row in one.observations),
    )

"""Map building from labels: triangulate label elements, link them, place the landmarks.

Each label element is triangulated from all its labels. Elements of one landmark are linked, and
the landmark is triangulated again, optionally by bundle adjustment with the frame poses. The map
records its options, frames, provenance and decisions, so it can be rebuilt from changed labels.
The report counts how the labels were used.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.association.detection_tracks import (
    DetectionCounts,
    JoinedDetections,
    TrackOptions,
    detection_labels,
)
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.tracks import (
    Tracks,
    find_tracks,
    finish_detected,
)
from semviz_annotation.mapping.decisions import decisions_of
from semviz_annotation.mapping.paper_baseline import PaperOptions, paper_tracks
from semviz_annotation.mapping.placement.bundle_adjustment import RefineOptions, with_pose_errors
from semviz_annotation.mapping.placement.observations import LabelObservations, collect_observations
from semviz_annotation.mapping.placement.reprojection import PlaceOptions
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Dataset
from semviz_core.base.semantic_map import Decision, Provenance, SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import Stopwatch
from semviz_core.common.progress import OnProgress, unwatched
from semviz_core.pose_checks.pose_covariance import PoseCovariance

PART_ID = 1_000_000
"""A landmark split off a label element has the id ``PART_ID`` * part + number."""


def map_elements(
    tracks: Tracks, log_odds: Mapping[str, float] = MappingProxyType({})
) -> tuple[Elements3D, tuple[Provenance, ...]]:
    """Return the landmarks with a position, sorted by id, and the provenance of each.

    ``log_odds`` are those of tracks of detections, by id of their label elements. A landmark that
    is made of several has those of the surest.

    The id is the smallest number of the label elements of a landmark, so it stays when labels are
    added. A landmark made only of parts of label elements has an id from ``PART_ID`` on.
    """
    ids, placed = _ids(tracks), tracks.placed
    rows = np.flatnonzero(placed.ok)
    rows = rows[np.argsort(ids[rows])]
    kind = np.zeros(len(ids), dtype=np.int64)
    kind[tracks.landmark] = [
        tracks.gathered.elements[row].class_id for row in tracks.nodes.element.tolist()
    ]
    elements = Elements3D(
        id=ids[rows],
        anchor_m=placed.anchor_m[rows],
        end_m=placed.end_m[rows],
        class_id=kind[rows],
        covariance_m2=placed.covariance_m2[rows],
        anchor_known=placed.anchor_known[rows],
        end_known=placed.end_known[rows],
    )
    provenance = list(_provenance(tracks, log_odds))
    return elements, tuple(provenance[row] for row in rows.tolist())


def attributes_of_elements(
    elements: Elements3D, provenance: Sequence[Provenance], labels: Labels
) -> dict[int, dict[str, str]]:
    """Return the attributes of map elements that have any; of two values, the label element with
    the smaller number has the right one."""
    found: dict[int, dict[str, str]] = {}
    for id_, origin in zip(elements.id.tolist(), provenance, strict=True):
        members = [labels.elements[row] for row in origin.label_ids if row in labels.elements]
        members.sort(key=lambda element: -element.number)
        rows = (row for element in members for row in labels.attributes_of(element.id))
        values = {row.name: row.value for row in rows}
        if values:
            found[id_] = dict(sorted(values.items()))
    return found


def _ids(tracks: Tracks) -> IntArray:
    """Return the ids (n,) of all landmarks."""
    nodes = tracks.nodes
    number = np.array([element.number for element in tracks.gathered.elements], dtype=np.int64)
    ids = np.full(tracks.observations.count, np.iinfo(np.int64).max)
    np.minimum.at(ids, tracks.landmark, number[nodes.element] + PART_ID * nodes.part)
    return ids


def _provenance(tracks: Tracks, log_odds: Mapping[str, float]) -> Iterator[Provenance]:
    """Yield for each landmark its label elements (by main part, else all) and observations."""
    gathered, nodes, observations = tracks.gathered, tracks.nodes, tracks.observations
    order = np.lexsort((nodes.element, tracks.landmark))
    members = np.split(
        order, np.searchsorted(tracks.landmark[order], np.arange(1, observations.count))
    )
    rows = np.split(observations.label_row, np.cumsum(observations.seen)[:-1])
    for some, label_rows in zip(members, rows, strict=True):
        main = some[nodes.part[some] == 0]
        named = main if len(main) else some
        all_ids = {gathered.elements[row].id for row in nodes.element[some].tolist()}
        is_detected = all_ids <= log_odds.keys()
        yield Provenance(
            tuple(gathered.elements[row].id for row in nodes.element[named].tolist()),
            tuple(gathered.label_rows[row].id for row in label_rows.tolist()),
            max((log_odds[id_] for id_ in all_ids), default=None) if is_detected else None,
        )


_MOST_LINES = 12
_MOST_NAMES = 6


@dataclass(frozen=True)
class BuildReport:
    """How the labels were used."""

    decisions: tuple[Decision, ...]
    """The decisions in the map."""
    names: dict[int, str]
    """Names of all label elements considered, by number."""
    observations: int
    """Number of observations considered."""
    used: int
    """Number of observations used in the map."""
    elements: int
    """Number of elements in the map."""
    detections: DetectionCounts | None = None
    """What became of the detections; None for a map of labels alone."""
    log_odds: Mapping[str, float] = field(default_factory=dict)
    """Log-odds that the landmark of a track exists, by id of its label element."""
    in_wrong_poses: frozenset[str] = frozenset()
    """Observations in frames with wrong poses: what is decided about them alone is not their
    labels' error."""

    @classmethod
    def of(
        cls,
        semantic_map: SemanticMap,
        gathered: LabelObservations,
        joined: JoinedDetections | None = None,
    ) -> "BuildReport":
        """Return the report of a map built from ``gathered``, with the tracks of ``joined``."""
        name = semantic_map.classes.element_name
        return cls(
            decisions=semantic_map.decisions,
            names={
                element.number: name(element.class_id, element.number)
                for element in gathered.elements
            },
            observations=len(gathered.label_rows),
            used=sum(len(provenance.observation_ids) for provenance in semantic_map.provenance),
            elements=len(semantic_map),
            detections=joined and joined.counts,
            log_odds=joined.log_odds if joined else {},
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        values = {
            "label_elements": len(self.names),
            "observations": self.observations,
            "used": self.used,
            "elements": self.elements,
            "decisions": [
                asdict(decision) | ({"pose_is_wrong": True} if self._is_of_pose(decision) else {})
                for decision in self.decisions
            ],
        }
        if self.detections is not None:
            values["detections"] = asdict(self.detections)
            values["track_log_odds"] = dict(self.log_odds)
        return values

    def __str__(self) -> str:
        first = [] if self.detections is None else [str(self.detections)]
        return "\n".join([*first, self._summary(), *self._lines()])

    def _summary(self) -> str:
        counts = Counter(decision.kind for decision in self.decisions)
        return (
            f"{len(self.names)} label elements, {self.used} of {self.observations} observations "
            f"used: {counts['merge']} merged, {counts['apart']} kept apart, {counts['split']} "
            f"split, {counts['leave out']} left out"
        )

    def _lines(self) -> Iterator[str]:
        """Yield one line per decision, with a limit per kind."""
        counts: Counter[str] = Counter()
        of_poses = [decision for decision in self.decisions if self._is_of_pose(decision)]
        if of_poses:
            yield (
                f"{len(of_poses)} of these decisions are about labels in frames with wrong poses, "
                "not about wrong labels"
            )
        for decision in self.decisions:
            if decision in of_poses:
                continue
            counts[decision.kind] += 1
            if counts[decision.kind] <= _MOST_LINES:
                yield f"{_WORDS[decision.kind]} {self._names(decision)}: {decision.reason}"
        for kind, count in counts.items():
            if count > _MOST_LINES:
                yield f"{_WORDS[kind]} {count - _MOST_LINES} more"

    def _is_of_pose(self, decision: Decision) -> bool:
        ids = set(decision.observation_ids)
        return bool(ids) and 2 * len(ids & self.in_wrong_poses) > len(ids)

    def _names(self, decision: Decision) -> str:
        names = [self.names[number] for number in decision.numbers]
        more = len(names) - _MOST_NAMES
        return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


_WORDS = {"merge": "merged", "apart": "kept apart", "split": "split", "leave out": "left out"}


@dataclass(frozen=True)
class BuildOptions:
    """Options of the method that uses all views jointly."""

    sigma_px: float = 1.0
    """Standard deviation of labels in each direction: 1 for people, 2 to 4 for detectors."""
    min_angle_deg: float = 0.5
    """Landmarks with smaller ray angles are left out: by stereo alone, with KITTI's baseline, from
    62 m on, where 1 px is 10 m."""
    pose_sigma_m: float = 0.05
    """Pose error in each direction between two passes, used for linking and for outliers. KITTI 02
    has about as much within one pass: 1 px at 30 m."""
    min_frames: int = 1
    """Landmarks seen in fewer frames are left out. 1 for people, who draw few false positives; 2 or
    3 for detectors."""
    refine: RefineOptions | None = None
    """Priors of the frame poses for bundle adjustment; None keeps the poses."""

    @property
    def place(self) -> PlaceOptions:
        return PlaceOptions(self.sigma_px, float(np.deg2rad(self.min_angle_deg)))


Options: TypeAlias = BuildOptions | PaperOptions
DEFAULT_OPTIONS = BuildOptions()
DEFAULT_TRACKING = TrackOptions()
_TRACKING = "tracking"
"""Key of ``TrackOptions`` in the settings of a map of detections."""
POSES = "poses"
"""Key, in the settings of a map, of what people chose for wrong poses, if anything."""


class BuildSettings(NamedTuple):
    """How a map was built."""

    options: Options
    frames: Collection[int] | None
    tracking: TrackOptions | None
    """How detections became tracks; None for a map of labels alone."""


def settings_of(
    options: Options, frames: Collection[int] | None, tracking: TrackOptions | None = None
) -> dict[str, Any]:
    """Return ``BuildSettings`` as JSON values; ``options_of`` is the inverse."""
    method = "paper" if isinstance(options, PaperOptions) else "joint"
    chosen = None if frames is None else sorted(frames)
    settings = {"method": method, "frames": chosen, **asdict(options)}
    return settings if tracking is None else settings | {_TRACKING: tracking.as_json()}


def options_of(settings: Mapping[str, Any]) -> BuildSettings:
    """Return how a map was built, from its ``settings``.

    Raise SemvizError if the map was not built from labels or detections, or by another version of
    semviz.
    """
    given = dict(settings)
    method, frames = given.pop("method", None), given.pop("frames", None)
    given.pop(POSES, None)  # those of the drive are used now
    try:
        tracking = given.pop(_TRACKING, None)
        tracking = None if tracking is None else TrackOptions.from_json(tracking)
        if method == "paper":
            return BuildSettings(PaperOptions(**given), frames, tracking)
        if method == "joint":
            given["refine"] = _refine_options(given["refine"])
            return BuildSettings(BuildOptions(**given), frames, tracking)
    except (KeyError, TypeError, ValueError):
        raise SemvizError(
            "this map was built by another version of semviz; run 'semviz map build'"
        ) from None
    raise SemvizError("this map does not say how it was built; run 'semviz map build'")


def _refine_options(given: Mapping[str, Any] | None) -> RefineOptions | None:
    if given is None:
        return None
    return RefineOptions(**(dict(given) | {"place": PlaceOptions(**given["place"])}))


def build_map(
    labels: Labels,
    source: Dataset,
    options: Options = DEFAULT_OPTIONS,
    frames: Collection[int] | None = None,
    on_progress: OnProgress = unwatched,
    detections: Proposals | None = None,
    tracking: TrackOptions = DEFAULT_TRACKING,
    poses: PoseCovariance | None = None,
    watch: Stopwatch | None = None,
) -> tuple[SemanticMap, BuildReport]:
    """Return the map of elements labelled in two or more images of ``frames`` (None: all).

    ``PaperOptions`` build the paper's map. With ``detections``, the landmarks that they show and
    nobody has labelled are added. With ``poses``, covariances include the errors of the poses;
    otherwise poses count as exact, unless they are refined. Triangular signs follow ``labels``.
    ``on_progress`` gets the stage, the count that is done, and the total; ``watch`` the time of
    "linking" the detections to tracks. Raise SemvizError if a labelled frame is not in the source
    or has no pose, or if nothing can be triangulated.
    """
    joined = None
    if detections is not None:
        linked = partial(_join, labels, detections, source, options, tracking, frames, on_progress)
        joined = (watch or Stopwatch()).time("linking", linked)
        labels = joined.labels
    gathered = collect_observations(labels, source, frames, joined.sigma_ratio if joined else {})
    if isinstance(options, PaperOptions):
        tracks = paper_tracks(gathered, options)
    else:
        linking = LinkOptions(options.place, options.pose_sigma_m, options.min_frames)
        prior = options.refine and replace(options.refine, place=options.place)
        tracks = find_tracks(labels, gathered, linking, prior, on_progress)
        if poses is not None and prior is None:
            views, observations = tracks.gathered.views, tracks.observations
            placed = with_pose_errors(views, observations, tracks.placed, options.place, poses)
            tracks = replace(tracks, placed=placed)
    if joined is not None:
        tracks = finish_detected(tracks, joined.log_odds.keys(), joined.min_frames)
    decisions = decisions_of(tracks)
    elements, provenance = map_elements(tracks, joined.log_odds if joined else {})
    if not len(elements):
        raise SemvizError(f"nothing can be placed; the first of all: {decisions[0].reason}")
    views = tracks.gathered.views
    semantic_map = SemanticMap(
        elements=elements,
        frame=source.map_frame,
        classes=labels.classes,
        trajectory_m=views.center_m[~views.is_right],
        provenance=provenance,
        decisions=decisions,
        made_by=f"semviz {version('semviz')}, {options}",
        settings=settings_of(options, frames, tracking if joined else None),
        operation=labels.operation,
        triangle_center=labels.triangle_center,
        attributes=attributes_of_elements(elements, provenance, labels),
    )
    return semantic_map, BuildReport.of(semantic_map, gathered, joined)


def _join(
    labels: Labels,
    detections: Proposals,
    source: Dataset,
    options: Options,
    tracking: TrackOptions,
    frames: Collection[int] | None,
    on_progress: OnProgress,
) -> JoinedDetections:
    if isinstance(options, PaperOptions):
        raise SemvizError("the paper's method takes labels only; leave out the detections")
    joined = detection_labels(
        labels,
        detections,
        source,
        LinkOptions(options.place, options.pose_sigma_m),
        tracking,
        frames,
        lambda done, of: on_progress("tracking detections", done, of),
    )
    if not joined.labels.elements:
        raise SemvizError(
            f"none of {joined.counts.detections} detections show a landmark often enough; detect "
            "in more frames, or allow fewer (--min-frames)"
        )
    return joined


def uses_detections(semantic_map: SemanticMap) -> bool:
    """Return whether a map was built from detections, too."""
    return _TRACKING in semantic_map.settings


def rebuild_map(
    old: SemanticMap,
    labels: Labels,
    source: Dataset,
    on_progress: OnProgress = unwatched,
    detections: Proposals | None = None,
    poses: PoseCovariance | None = None,
) -> tuple[SemanticMap, BuildReport]:
    """Return the map of the present labels, built like ``old``; ``poses`` as in ``build_map``.

    Only a map of detections uses ``detections``, and needs them. Raise SemvizError like
    ``build_map``, and if ``old`` was not built from labels or detections.
    """
    options, frames, tracking = options_of(old.settings)
    if tracking is None:
        detections = None
    elif detections is None:
        raise SemvizError("this map was built from detections, and there are none any more")
    return build_map(
        labels,
        source,
        options,
        frames,
        on_progress,
        detections,
        tracking or DEFAULT_TRACKING,
        poses,
    )

"""Labels to a map.

Each label element is placed by all its labels. Those that are one thing are linked, and the things
placed again; if wanted, together with the poses of the frames. What was decided is kept.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.assemble import elements_of
from semviz_annotation.mapping.decided import decisions_of
from semviz_annotation.mapping.linking.rounds import LinkOptions
from semviz_annotation.mapping.linking.tracks import OnProgress, find_tracks, with_poses
from semviz_annotation.mapping.paper import PaperOptions, paper_tracks
from semviz_annotation.mapping.placing.least_squares import PlaceOptions
from semviz_annotation.mapping.placing.refine import RefineOptions
from semviz_annotation.mapping.placing.sightings import gather
from semviz_annotation.mapping.report import BuildReport
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source


@dataclass(frozen=True)
class BuildOptions:
    """How labels become a map."""

    sigma_px: float = 1.0
    """How well labels are placed, in each direction: 1 for people, 2 to 4 for detectors."""
    min_angle_deg: float = 0.5
    """Things whose rays are all nearer to parallel are left out: by stereo alone, with KITTI's
    baseline, from 62 m on, where 1 px is 10 m."""
    pose_sigma_m: float = 0.05
    """How far poses may be off, in each direction, from one pass to the next. KITTI 02 shows about
    as much within one: 1 px at 30 m. For linking, and for telling misplaced labels."""
    min_frames: int = 1
    """What fewer frames show is left out. People draw no noise; with a detector, 2 or 3."""
    refine: RefineOptions | None = None
    """Priors of the frames' poses, to move these too; None keeps them."""

    @property
    def place(self) -> PlaceOptions:
        return PlaceOptions(self.sigma_px, float(np.deg2rad(self.min_angle_deg)))


def build_map(
    labels: Labels,
    source: Source,
    options: BuildOptions | PaperOptions = BuildOptions(),
    frames: Collection[int] | None = None,
    classes: ClassSet = DEFAULT_CLASSES,
    on_progress: OnProgress = lambda what, done, of: None,
) -> tuple[SemanticMap, BuildReport]:
    """A map of what is labelled in two or more images of ``frames`` (None: all), and what became
    of the labels. ``PaperOptions`` make the paper's map.

    Raises SemvizError where a labelled frame is not in the source or has no pose, or nothing can
    be placed.
    """
    gathered = gather(labels, source, frames)
    if isinstance(options, PaperOptions):
        tracks = paper_tracks(gathered, options)
    else:
        linking = LinkOptions(options.place, options.pose_sigma_m, options.min_frames)
        tracks = find_tracks(labels, gathered, linking, on_progress)
        if options.refine is not None:
            tracks = with_poses(tracks, replace(options.refine, place=options.place), on_progress)
    decisions = decisions_of(tracks)
    elements, provenance = elements_of(tracks)
    if not len(elements):
        raise SemvizError(f"nothing can be placed; the first of all: {decisions[0].reason}")
    views = tracks.gathered.views
    semantic_map = SemanticMap(
        elements=elements,
        frame=source.map_frame,
        classes=classes,
        trajectory_m=views.center_m[~views.is_right],
        provenance=provenance,
        decisions=decisions,
        made_by=f"semviz {version('semviz')}, {options}",
        operation=labels.operation,
    )
    return semantic_map, BuildReport.of(semantic_map, gathered)

"""Labels to a map.

Each label element is placed by all its labels. Those that are one thing are linked, and the things
placed again; if wanted, together with the poses of the frames. What was decided is kept.
"""

from collections.abc import Collection
from dataclasses import replace
from importlib.metadata import version

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.assemble import elements_of
from semviz_annotation.mapping.decided import decisions_of
from semviz_annotation.mapping.linking.rounds import LinkOptions
from semviz_annotation.mapping.linking.tracks import OnProgress, find_tracks
from semviz_annotation.mapping.options import AS_USUAL, Options, options_of, settings_of
from semviz_annotation.mapping.paper import PaperOptions, paper_tracks
from semviz_annotation.mapping.placing.sightings import gather
from semviz_annotation.mapping.report import BuildReport
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source


def build_map(
    labels: Labels,
    source: Source,
    options: Options = AS_USUAL,
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
        poses = options.refine and replace(options.refine, place=options.place)
        tracks = find_tracks(labels, gathered, linking, poses, on_progress)
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
        settings=settings_of(options, frames),
        operation=labels.operation,
    )
    return semantic_map, BuildReport.of(semantic_map, gathered)


def rebuild_map(
    old: SemanticMap,
    labels: Labels,
    source: Source,
    on_progress: OnProgress = lambda what, done, of: None,
) -> tuple[SemanticMap, BuildReport]:
    """As ``old`` was built, from labels as they are now.

    Raises SemvizError as ``build_map`` does, and where ``old`` was not built from labels.
    """
    options, frames = options_of(old.settings)
    return build_map(labels, source, options, frames, old.classes, on_progress)

"""The street of the demo: localized, with some frames that fail for known reasons.

Along the drive: an ordinary street; one of its poles is labelled wrongly and so stands elsewhere in
the map, which matters where few others are in view; a stretch with too little to see; an ordinary
street with a few GPS fixes that are far off; a row of equal poles, where one place looks like the
next; and an ordinary street again.
"""

from pathlib import Path

from semviz.demo_labels import AUTHOR, SIGMA_PX, demo_labels
from semviz.drive import (
    CROP_RADIUS_M,
    Drive,
    DriveOptions,
    Know,
    record,
    simulated_prior,
)
from semviz.observing import detector_model, observe_simulated
from semviz.workspace import Workspace
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.options import BuildOptions
from semviz_core.frame import Frame, Prior
from semviz_core.localize import Localizer
from semviz_core.map_file import save_map
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.priors import PriorOptions, simulate_prior
from semviz_core.sources.street.layout import Section
from semviz_core.sources.street.street import Street

SEED = 7
FRAMES = 120
SPACING_M = 2.0
SECTIONS = (
    Section("normal", 80.0),
    Section("sparse", 40.0),
    Section("normal", 70.0),
    Section("row", 60.0),
    Section("normal", 60.0),
)
MOVED_IN_FRAMES = range(20, 29)
SLIP_FRAME = 24
FAR_OFF_FRAMES = range(72, 76)
FAR_OFF_M = (70.0, 75.0)
MAP = "main"
RUN = "demo"


def make_demo(folder: Path) -> None:
    """A new workspace in ``folder`` with street, labels, map and run."""
    workspace = Workspace.create_street(folder, SEED, range(FRAMES), SPACING_M, SECTIONS)
    street = workspace.street
    with workspace.open_labels() as store:
        slipped = _often_seen(street, MOVED_IN_FRAMES)
        store.apply(demo_labels(street, slipped, SLIP_FRAME), AUTHOR)
        labels = store.labels
    built, _ = build_map(labels, street, BuildOptions(sigma_px=SIGMA_PX))
    save_map(built, workspace.map_path(MAP))
    drive = _drive(workspace, built)
    record(drive, workspace.run_path(RUN), workspace="", map_name=MAP)


def _drive(workspace: Workspace, semantic_map: SemanticMap) -> Drive:
    options = DriveOptions(
        observations="simulated", crop_radius_m=CROP_RADIUS_M["simulated"], seed=SEED
    )
    observe = observe_simulated(workspace, options.noise, options.seed)
    know = _sometimes_far_off(simulated_prior(options))
    street = workspace.street
    localizer = Localizer(detector=detector_model(options.observations))
    return Drive(street, semantic_map, street.frames, observe, know, localizer, options)


def _often_seen(street: Street, frames: range) -> int:
    """The map element that most of ``frames`` see."""
    counts: dict[int, int] = {}
    for index in frames:
        for element_id in street.labels(index, "left")[1]:
            counts[int(element_id)] = counts.get(int(element_id), 0) + 1
    return max(counts, key=lambda element_id: (counts[element_id], -element_id))


def _sometimes_far_off(know: Know) -> Know:
    far_off = PriorOptions(distance_m=FAR_OFF_M)

    def know_or_err(frame: Frame) -> Prior:
        honest = know(frame)
        if frame.index not in FAR_OFF_FRAMES or frame.T_map_camera is None:
            return honest
        lost = simulate_prior(frame.T_map_camera, far_off, (SEED, frame.index))
        # The fix is far off and does not know it: its stated sigma is that of an ordinary one.
        return Prior(lost.position_m, honest.horizontal_sigma_m, up_camera=lost.up_camera)

    return know_or_err

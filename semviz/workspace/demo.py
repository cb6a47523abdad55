"""Make the built-in demo: a street whose run has known faults, cached for the user.

The street has in turn: an ordinary stretch; one of its poles labelled in the wrong place, which
matters where few others are in view; a stretch with too few elements; an ordinary stretch with
a few wrong GPS fixes; a row of equal poles, whose positions cannot be distinguished; and an
ordinary stretch. Every third frame is labelled, and one label is wrong. The demo is made once,
with a progress bar, and kept in the user's cache folder.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import platformdirs

from semviz.runs.run import detector_model
from semviz.workspace.localization import localize
from semviz.workspace.localization.simulated_measurements import (
    PriorSource,
    simulated_odometry,
    simulated_prior,
)
from semviz.workspace.observations import observe_simulated
from semviz.workspace.workspace import Workspace
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.rows import LabelElement, Observation, derived_id
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_core.base.frame import Frame, Prior, Side
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.simulation.layout import Section
from semviz_core.simulation.street import Street

EDITION = 6
"""Increased with every change of the demo, so that an old one in the cache is not used."""


def ensure_demo() -> Path:
    """Return the demo's workspace in the user's cache folder; make it if it is missing.

    Raise SemvizError if the folder cannot be written.
    """
    cache = platformdirs.user_cache_path("semviz")
    folder = cache / f"demo-{version('semviz')}-{EDITION}"
    if folder.is_dir():
        return folder

    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix=".demo-") as unfinished:
            make_demo(Path(unfinished) / "demo")
            (Path(unfinished) / "demo").rename(folder)  # complete or absent
    except OSError as error:
        if folder.is_dir():  # another process was quicker
            return folder
        raise SemvizError(f"{cache}: the demo cannot be written ({error.strerror})") from None
    return folder


AUTHOR = "demo"
LABELLED_EVERY = 3
SIGMA_PX = 0.3
SLIP_PX: dict[Side, float] = {"left": -36.0, "right": -34.5}
SIDES: tuple[Side, Side] = ("left", "right")


def demo_labels(street: Street, slipped: int, frame: int) -> ImportLabels:
    """Label every third frame of the street; elements have their numbers in its true map.

    The pole ``slipped`` is labelled in ``frame`` alone, off by ``SLIP_PX`` along the image row, so
    that no other label contradicts it.
    """
    frames = range(0, len(street.frames), LABELLED_EVERY)
    drawn = [
        observation
        for index in frames
        for side in SIDES
        for observation in _drawn(street, index, side)
    ]
    name = _name(slipped)
    rows = [observation for observation in drawn if observation.element_id != name]
    rows += [
        _slip(observation)
        for observation in drawn
        if (observation.element_id, observation.frame_index) == (name, frame)
    ]
    seen = {row.element_id for row in rows}
    mapped = street.truth_map.elements
    classes = zip(mapped.id.tolist(), mapped.class_id.tolist(), strict=True)
    elements = (LabelElement(_name(number), number, class_id) for number, class_id in classes)
    return ImportLabels(tuple(element for element in elements if element.id in seen), tuple(rows))


def _drawn(street: Street, index: int, side: Side) -> Iterator[Observation]:
    """Yield the labels of a careful person: each coordinate has an error of ``SIGMA_PX``."""
    rng = np.random.default_rng([street.seed, index, side == "right"])
    visible, numbers = street.labels(index, side)
    camera = street.rig.left
    corner = np.array([camera.width - 1.0, camera.height - 1.0])
    error_px = rng.normal(0.0, SIGMA_PX, (2, len(visible), 2))
    drawn = replace(
        visible,
        anchor_px=(visible.anchor_px + error_px[0]).clip(0.0, corner),
        end_px=(visible.end_px + error_px[1]).clip(0.0, corner),
    )
    for row, number in enumerate(numbers.tolist()):
        id = derived_id(f"observation {index} {side} {number}")
        yield Mark.of_element(drawn, row).at(index, side, id, _name(number))


def _slip(row: Observation) -> Observation:
    (u, v), by = row.anchor_px, SLIP_PX[row.side]
    end = None if row.end_px is None else (row.end_px[0] + by, row.end_px[1])
    return replace(row, anchor_px=(u + by, v), end_px=end)


def _name(number: int) -> str:
    """Return the id of the label element with a number."""
    return derived_id(f"element {number}")


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
    """Make a workspace in ``folder`` with street, labels, map and run."""
    workspace = Workspace.create_street(folder, SEED, range(FRAMES), SPACING_M, SECTIONS)
    street = workspace.street
    with workspace.open_labels() as store:
        slipped = _often_seen(street, MOVED_IN_FRAMES)
        store.apply(demo_labels(street, slipped, SLIP_FRAME), AUTHOR)
        labels = store.labels
    built, _ = build_map(labels, street, BuildOptions(sigma_px=SIGMA_PX))
    save_map(built, workspace.map_path(MAP))
    localization = _localization(workspace, built)
    localize.record(localization, workspace.run_path(RUN), workspace="", map_name=MAP)


def _localization(workspace: Workspace, semantic_map: SemanticMap) -> localize.SequenceLocalization:
    options = localize.LocalizeOptions(
        observations="simulated", crop_radius_m=localize.CROP_RADIUS_M["simulated"], seed=SEED
    )
    observe = observe_simulated(workspace, semantic_map, options.noise, options.seed)
    prior_of = _sometimes_wrong(simulated_prior(options))
    street = workspace.street
    localizer = Localizer(detector=detector_model(options.observations))
    return localize.SequenceLocalization(
        street,
        semantic_map,
        street.frames,
        observe,
        prior_of,
        simulated_odometry(options.seed),
        localizer,
        options,
    )


def _often_seen(street: Street, frames: range) -> int:
    """Return the map element that is visible in most of ``frames``."""
    counts: dict[int, int] = {}
    for index in frames:
        for element_id in street.labels(index, "left")[1]:
            counts[int(element_id)] = counts.get(int(element_id), 0) + 1
    return max(counts, key=lambda element_id: (counts[element_id], -element_id))


def _sometimes_wrong(prior_of: PriorSource) -> PriorSource:
    far_off = PriorOptions(distance_m=FAR_OFF_M)

    def wrong_prior_of(frame: Frame) -> Prior | None:
        usual = prior_of(frame)
        if usual is None or frame.index not in FAR_OFF_FRAMES or frame.T_map_camera is None:
            return usual
        wrong = simulate_prior(frame.T_map_camera, far_off, (SEED, frame.index))
        # The fix is far off, but its stated sigma is the usual one.
        return Prior(wrong.position_m, usual.horizontal_sigma_m, up_camera=wrong.up_camera)

    return wrong_prior_of

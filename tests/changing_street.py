"""A simulated street that changes, and passes through it, localized in its first map."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_annotation.mapping.passes.evidence import Pass
from semviz_core.base.detector_model import SIMULATED_DETECTOR, NoiseName
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import IntArray
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.roads import move_element
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.street import Street

STEP = 2
"""Every second frame is used."""
SHOWN = 4
"""An element counts if so many frames show it."""
PRIOR = PriorOptions()


@dataclass(frozen=True, eq=False)
class ChangingStreet:
    """A street, and what changes in it: ids, and the first pass after the change."""

    street: Street
    vanishes: dict[int, int]
    appears: dict[int, int]
    moves: dict[int, int]
    offset_m: dict[int, np.ndarray]
    """Of each element that moves, from where it is to where it was."""

    @property
    def first_map(self) -> SemanticMap:
        """The map before the first pass."""
        first = self.street.truth_map
        for id_, by_m in self.offset_m.items():
            first = move_element(first, id_, by_m)
        kept = ~np.isin(first.elements.id, list(self.appears))
        return replace(first, elements=first.elements[kept])

    def is_shown(self, id_: int) -> bool:
        """Return whether enough frames show an element, wherever else it stands by then."""
        return self.frames_that_show(id_) >= SHOWN

    def frames_that_show(self, id_: int) -> int:
        return self._shown[id_]

    @cached_property
    def _shown(self) -> Counter[int]:
        near = SIMULATED_DETECTOR.far_m
        shown: Counter[int] = Counter()
        for frame in self.street.frames[::STEP]:
            ids = self.street.labels(frame.index, "left")[1]
            shown.update(ids[self.street.distance_m(ids, frame.index, "left") < near].tolist())
        return shown

    def hidden(self, number: int, share: float) -> set[int]:
        """Return the elements that things hide throughout a pass, a share of all."""
        rng = np.random.default_rng([self.street.seed, 2, number])
        ids = self.street.truth_map.elements.id
        return set(ids[rng.random(len(ids)) < share].tolist())

    def detections(
        self, number: int, index: int, noise: NoiseName, hidden: set[int]
    ) -> tuple[Elements2D, IntArray]:
        """Return the detections (m) of a frame of a pass, and which element (m,) each is of; -1: of
        none."""
        detection = SimulatedDetector(self.street, noise, number).detect(index)
        is_there = [self._is_there(id_, number, hidden) for id_ in detection.element_id.tolist()]
        rows = np.flatnonzero(is_there)
        observed, ids = detection.observed[rows], detection.element_id[rows]
        anchor_px, end_px = observed.anchor_px.copy(), observed.end_px.copy()
        elements = self.street.truth_map.elements
        pose = self.street.frames[index].T_map_camera
        assert pose is not None
        for row, id_ in enumerate(ids.tolist()):
            if id_ in self.moves and number < self.moves[id_]:
                true = elements[elements.id == id_]
                shift = [self._shift_px(point, id_, pose) for point in (true.anchor_m, true.end_m)]
                anchor_px[row] += shift[0]
                end_px[row] += shift[1]
        return replace(observed, anchor_px=anchor_px, end_px=end_px), ids

    def _is_there(self, id_: int, number: int, hidden: set[int]) -> bool:
        if id_ < 0:
            return True
        after, before = self.vanishes.get(id_, 1000), self.appears.get(id_, 0)
        return before <= number < after and id_ not in hidden

    def _shift_px(self, point_m: np.ndarray, id_: int, T_map_camera: Pose) -> np.ndarray:
        camera, T = self.street.rig.left, T_map_camera.inverse()
        return (
            camera.project(T.apply(point_m + self.offset_m[id_])) - camera.project(T.apply(point_m))
        )[0]


def drive(
    world: ChangingStreet, number: int, noise: NoiseName = "low", hidden_share: float = 0.0
) -> Pass:
    """Localize one pass in the first map; things hide a share of the elements throughout."""
    hidden = world.hidden(number, hidden_share)
    first, camera = world.first_map, world.street.rig.left
    localizer = Localizer(detector=SIMULATED_DETECTOR)
    frames: list[Frame] = []
    results: list[Localization] = []
    for frame in world.street.frames[number % STEP :: STEP]:
        assert frame.T_map_camera is not None
        prior = simulate_prior(frame.T_map_camera, PRIOR, [number, frame.index])
        observed, _ = world.detections(number, frame.index, noise, hidden)
        submap = first.crop(prior.position_m, 50.0)
        frames.append(replace(frame, T_map_camera=None))
        results.append(localizer.localize(observed, submap, camera, prior))
    return Pass(f"{number}", tuple(frames), tuple(results), SIMULATED_DETECTOR)


def place_m(semantic_map: SemanticMap, id_: int) -> np.ndarray:
    """(2,) where an element stands."""
    elements = semantic_map.elements
    return footprint_m(elements[elements.id == id_])[0, :2]

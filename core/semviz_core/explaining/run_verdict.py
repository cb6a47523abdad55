"""What a run says of its map and camera: faults that come back in frame after frame."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.detector_model import DetectorModel
from semviz_core.explaining.calibration import calibration_fault
from semviz_core.explaining.case import Case, Watch, unwatched
from semviz_core.explaining.faults import noticed
from semviz_core.explaining.places import NEEDED_FRAMES, Place, Sights, meeting_places
from semviz_core.explaining.told import Evidence, Fault, Kind, Truth
from semviz_core.localization import Localization
from semviz_core.semantic_map import SemanticMap

OF_ELEMENTS: tuple[Kind, ...] = ("moved in the map", "missing in the map", "twice in the map")
STRANGERS: tuple[Kind, ...] = ("moved in the map", "false or not mapped")
"""What single frames say of detections of which they cannot know more."""
MOVED_M = 10.0
"""What stands further from an element that is not seen is another thing."""
LEAST_SHARE = 0.5
"""Of the frames that see an element, so many must say the same."""


@dataclass(frozen=True)
class RunFault(Fault):
    """A fault that comes back; ``rows`` has one observed row for each of ``frames``."""

    frames: tuple[int, ...] = ()
    """Positions in the run of those that say so."""


@dataclass(frozen=True)
class RunVerdict:
    """Faults of the camera, then of map elements, those in most frames first."""

    calibration: Fault | None
    elements: tuple[RunFault, ...]
    """Empty where the calibration is wrong: then nothing fits, and no element is to blame."""
    frames: int
    """That have a pose to compare with."""


def explain_run(
    frames: Sequence[tuple[Localization, Truth | None]],
    semantic_map: SemanticMap,
    detector: DetectorModel | None = None,
    watch: Watch = unwatched,
) -> RunVerdict:
    """What frames of one run say together; those without truth count where they were answered
    surely."""
    positions = [
        position
        for position, (one, truth) in enumerate(frames)
        if truth is not None or one.status == "ok"
    ]
    compared = [frames[position] for position in positions]
    cases = [Case.of(one, semantic_map, truth, detector) for one, truth in compared]
    calibration = calibration_fault(cases, watch)
    found = () if calibration else _of_elements(cases, watch)
    elements = (replace(one, frames=tuple(positions[row] for row in one.frames)) for one in found)
    return RunVerdict(calibration, tuple(elements), len(cases))


def _of_elements(cases: Sequence[Case], watch: Watch) -> tuple[RunFault, ...]:
    """Their frames are rows of ``cases``."""
    faults = [noticed(case) for case in watch(cases, "looking for what comes back", len(cases))]
    found = [*_repeated(cases, faults), *_strangers(cases, faults)]
    return tuple(sorted(found, key=lambda one: (-one.evidence[0].value, one.elements)))


def _repeated(cases: Sequence[Case], faults: Sequence[tuple[Fault, ...]]) -> list[RunFault]:
    """What is said of an element itself in several frames, and in most that see it."""
    said: dict[tuple[Kind, tuple[int, ...]], list[tuple[int, Fault]]] = defaultdict(list)
    for row, (case, ones) in enumerate(zip(cases, faults, strict=True)):
        sure = OF_ELEMENTS if case.ids is not None else OF_ELEMENTS[2:]
        for one in ones:
            if one.kind in sure:
                said[one.kind, tuple(sorted(one.elements))].append((row, one))
    seen = _times_seen(cases)
    return [
        _come_back(kind, elements, ones)
        for (kind, elements), ones in said.items()
        if len(ones) >= max(NEEDED_FRAMES, LEAST_SHARE * max(seen.get(one, 0) for one in elements))
        and not (len(elements) > 1 and _seen_together(cases, elements))
    ]


def _come_back(
    kind: Kind, elements: tuple[int, ...], said: Sequence[tuple[int, Fault]]
) -> RunFault:
    """What several frames say of ``elements``, with the evidence of the one in the middle."""
    ordered = sorted((fault for _, fault in said), key=lambda one: one.evidence[-1:])
    middle = ordered[len(ordered) // 2]
    sentence = f"In {len(said)} frames: {middle.sentence}"
    if kind == "missing in the map":  # it has no name, and other numbers in other frames
        sentence = f"{len(said)} frames see element {elements[0]}, which is not in the map."
    return RunFault(
        kind,
        sentence,
        (Evidence("frames", len(said)), *middle.evidence),
        elements,
        rows=tuple(fault.rows[0] for _, fault in said),
        frames=tuple(row for row, _ in said),
    )


def _seen_together(cases: Sequence[Case], elements: tuple[int, ...]) -> bool:
    """Whether one frame has a detection of each: then they are two things."""
    return any(set(elements) <= set(case.nearby.id[case.pairs[:, 1]].tolist()) for case in cases)


def _times_seen(cases: Sequence[Case]) -> dict[int, int]:
    """Of each element id, the frames that have a detection of it."""
    seen: dict[int, int] = defaultdict(int)
    for case in cases:
        for id in set(case.nearby.id[case.pairs[:, 1]].tolist()):
            seen[id] += 1
    return dict(seen)


def _strangers(cases: Sequence[Case], faults: Sequence[tuple[Fault, ...]]) -> list[RunFault]:
    """Things that several frames see where none is mapped."""
    sights, seen = _sights(cases, faults), _times_seen(cases)
    return [_stranger(cases, seen, sights, place) for place in meeting_places(sights)]


def _sights(cases: Sequence[Case], faults: Sequence[tuple[Fault, ...]]) -> Sights:
    rows = [
        (frame, one.rows[0])
        for frame, (case, ones) in enumerate(zip(cases, faults, strict=True))
        for one in ones
        if case.ids is None and one.kind in STRANGERS
    ]
    frame, row = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    rays, centers = np.empty((len(rows), 2)), np.empty((len(rows), 2))
    class_id = np.empty(len(rows), dtype=np.int64)
    for k, (position, i) in enumerate(rows):
        case = cases[position]
        assert case.reference is not None
        back, one = case.reference.inverse(), case.scene.seen[i]
        ray = (back.rotation @ one["anchor_ray"])[:2]
        rays[k], centers[k] = ray / np.linalg.norm(ray), back.translation[:2]
        class_id[k] = case.localization.observed.class_id[i]
    return Sights(frame, row, class_id, centers, rays)


def _stranger(
    cases: Sequence[Case], seen: dict[int, int], sights: Sights, place: Place
) -> RunFault:
    """A place's element that is nowhere seen and near is taken for the same thing, moved."""
    frames, first = np.unique(sights.frame[place.sights], return_index=True)
    rows = sights.row[place.sights[first]]
    of_frames = {"rows": tuple(rows.tolist()), "frames": tuple(frames.tolist())}
    class_id = int(sights.class_id[place.sights[0]])
    near: dict[int, float] = {}
    for case in (cases[one] for one in frames):
        away_m = np.linalg.norm(case.nearby.anchor_m[:, :2] - place.at_m, axis=1)
        for j in np.flatnonzero((away_m < MOVED_M) & (case.nearby.class_id == class_id)):
            near[int(case.nearby.id[j])] = float(away_m[j])
    expected = {id: away for id, away in near.items() if id not in seen and _expected(cases, id)}
    evidence = Evidence("frames", len(frames))
    where = f"at {place.at_m[0]:.1f}, {place.at_m[1]:.1f}"
    if not expected:
        return RunFault(
            "missing in the map", f"{len(frames)} frames see something {where} that is not mapped.",
            (evidence, Evidence("x", place.at_m[0], "m"), Evidence("y", place.at_m[1], "m")),
            **of_frames,
        )  # fmt: skip
    id = min(expected, key=lambda one: expected[one])
    name = cases[0].semantic_map.classes.element_name(class_id, id)
    return RunFault(
        "moved in the map",
        f"{name} is never seen where it is mapped; {len(frames)} frames see it {where}.",
        (evidence, Evidence("moved", expected[id], "m")), (id,), **of_frames,
    )  # fmt: skip


def _expected(cases: Sequence[Case], id: int) -> bool:
    """Whether an element should have been seen in several frames."""
    times = sum(bool((case.in_view & (case.nearby.id == id)).any()) for case in cases)
    return times >= NEEDED_FRAMES

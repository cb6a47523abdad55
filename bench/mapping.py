"""Quality of maps of simulated streets: semviz compared with the paper's method.

    OMP_NUM_THREADS=1 python bench/mapping.py [--seeds 1 2 3]
    OMP_NUM_THREADS=1 python bench/mapping.py --big
    OMP_NUM_THREADS=1 python bench/mapping.py --detections

Streets have seeds from 1000 on; nothing was tuned on these. --big: time and memory of a long drive.
--detections: the same for a map from detections, of which 30 % are missed and 4 an image are false.

Columns. complete: share of the landmarks that the labels would fix to 0.3 m, if it were known what
is what, which the map has within 1 m. twice: elements too many, over all landmarks. merged:
elements of two landmarks, each with a fifth of the observations; in brackets, of two that one image
shows. false: elements that are mostly nothing. error: RMS of the position; bound: over that of an
efficient estimator that knows what is what, and the true noise.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import TypeAlias

import numpy as np
import tests_support  # noqa: F401
from support.street_labels import (
    Detect,
    DrivenTwice,
    StreetLabels,
    careful,
    label_street,
    with_mistakes,
)

from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_annotation.mapping.paper_baseline import PaperOptions
from semviz_annotation.mapping.placement.bundle_adjustment import RefineOptions
from semviz_annotation.mapping.placement.observations import collect_observations
from semviz_annotation.mapping.placement.reprojection import residuals
from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.simulation.detector import Detection, SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

Way: TypeAlias = BuildOptions | PaperOptions
street_of = cache(Street)
FIXED_M, FOUND_M, SHARE = 0.3, 1.0, 0.2
EPS_M = (0.25, 0.5, 1.0, 2.0, 4.0)
NEAR_M, FAR_M = 6.0, 40.0
"""Between which a long drive shows landmarks."""


@dataclass(frozen=True)
class Case:
    """One way of labelling."""

    name: str
    detect: Callable[[Street, int], Detect]
    sigma_px: float
    """What map building is told."""
    min_frames: int
    shift_px: float | None = None
    """By how much a pole is off as a whole; None where its ends are off by themselves."""


CASES = (
    Case("careful clicks, 0.5 px", lambda street, seed: careful(street, 0.5, seed), 0.5, 1),
    Case("detector, low noise", lambda s, k: SimulatedDetector(s, "low", k).detect, 1.3, 2, 1.0),
    Case(
        "detector, paper's noise", lambda s, k: SimulatedDetector(s, "paper", k).detect, 3.0, 2, 1.5
    ),
)


@dataclass
class Score:
    """Sums over streets."""

    possible: int = 0
    found: int = 0
    things: int = 0
    twice: int = 0
    merged: int = 0
    together: int = 0
    """Merged, of landmarks that one image shows."""
    false: int = 0
    squared_m2: float = 0.0
    bound_m2: float = 0.0

    def add(self, other: "Score") -> None:
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def __str__(self) -> str:
        complete = self.found / self.possible
        ratio = np.sqrt(self.squared_m2 / self.bound_m2) if self.bound_m2 else np.nan
        rms = np.sqrt(self.squared_m2 / max(self.found, 1))
        return (
            f"{complete:9.1%} {self.twice:6d} {self.merged:6d} ({self.together:3d}) "
            f"{self.false:6d} {rms:8.3f} m {ratio:8.2f}"
        )


HEAD = f"{'':36}{'complete':>9} {'twice':>6} {'merged':>12} {'false':>6} {'error':>10} {'bound':>8}"


@dataclass(frozen=True, eq=False)
class Judge:
    """Knows the truth of one street's labels."""

    street: Street
    given: StreetLabels
    bounds: dict[int, float]
    """m2, of what can be found, by id"""
    together: set[frozenset[int]]

    @classmethod
    def of(
        cls, street: Street, given: StreetLabels, source: Dataset, shift_px: float | None
    ) -> "Judge":
        bounds = dict(_bounds(street, given, source, shift_px))
        return cls(street, given, bounds, _together(given))

    def score(self, built: SemanticMap) -> Score:
        result = Score(possible=len(self.bounds))
        best: dict[int, float] = {}
        count: Counter[int] = Counter()
        for row, entry in enumerate(built.provenance):
            things = Counter(self.given.truth[name].element_id for name in entry.observation_ids)
            landmark, most = things.most_common(1)[0]
            enough = [
                t for t, n in things.items() if t >= 0 and n >= max(2, SHARE * things.total())
            ]
            result.merged += len(enough) > 1
            pairs = (frozenset(pair) for pair in combinations(enough, 2))
            result.together += any(pair in self.together for pair in pairs)
            if landmark < 0 or most <= things.total() / 2:
                result.false += 1
                continue
            count[landmark] += 1
            error = self._error_m(built.elements, row, landmark)
            best[landmark] = min(error, best.get(landmark, np.inf))
        result.things = len(count)
        result.twice = count.total() - len(count)
        for landmark, bound in self.bounds.items():
            if best.get(landmark, np.inf) <= FOUND_M:
                result.found += 1
                result.squared_m2 += best[landmark] ** 2
                result.bound_m2 += bound
        return result

    def _error_m(self, elements: Elements3D, row: int, landmark: int) -> float:
        """Of a sign's middle; of a pole on the ground plane, half-way up the true one."""
        truth = self.street.truth_map.elements
        true = int(np.searchsorted(truth.id, landmark))
        if truth.is_line[true] != elements.is_line[row]:
            return float("inf")
        anchor, end = elements.anchor_m[row], elements.end_m[row]
        if not truth.is_line[true]:
            return float(np.linalg.norm(anchor - truth.anchor_m[true]))
        middle = (truth.anchor_m[true] + truth.end_m[true]) / 2.0
        at = anchor + (end - anchor) * (middle[2] - anchor[2]) / (end[2] - anchor[2])
        return float(np.linalg.norm((at - middle)[:2]))


def _bounds(
    street: Street, given: StreetLabels, source: Dataset, shift_px: float | None
) -> Iterator[tuple[int, float]]:
    """(id, m2) of what two or more frames show, and the labels fix well."""
    gathered = collect_observations(given.labels, source)
    true = np.array([given.truth[observation.id].element_id for observation in gathered.label_rows])
    sigma = np.array([given.truth[observation.id].sigma_px for observation in gathered.label_rows])
    truth = street.truth_map.elements
    landmark = np.where(true >= 0, np.searchsorted(truth.id, true), -1)
    observations = gathered.observations.regrouped(landmark, len(truth))
    at = residuals(gathered.views, observations, truth.anchor_m, truth.end_m)
    J = _whitened(at.J, observations.is_line, *sigma[observations.label_row].T, shift_px)
    information = observations.per_landmark(np.add, J.transpose(0, 2, 1) @ J)
    frame = gathered.views.frame_index[observations.view]
    frames = np.bincount(
        np.unique(np.stack([observations.landmark, frame]), axis=1)[0], minlength=len(truth)
    )
    for row in np.flatnonzero(frames >= 2):
        if truth.is_line[row]:
            covariance = np.linalg.pinv(information[row], hermitian=True)
            middle = covariance.reshape(2, 3, 2, 3).sum(axis=(0, 2))[:2, :2] / 4.0
        else:
            middle = np.linalg.pinv(information[row, :3, :3], hermitian=True)
        if np.linalg.eigvalsh(middle)[-1] <= FIXED_M**2 and observations.seen[row] >= 4:
            yield int(truth.id[row]), float(np.trace(middle))


def _whitened(
    J: FloatArray,
    is_line: BoolArray,
    across_px: FloatArray,
    along_px: FloatArray,
    shift_px: float | None,
) -> FloatArray:
    """J (k, 4, 6) by errors that are independent, each in multiples of its sigma.

    A detector shifts and turns a pole: its ends are then off together, and against each other.
    """
    shift = across_px / np.sqrt(2.0) if shift_px is None else np.full(len(J), shift_px)
    turn = np.sqrt(across_px**2 - shift**2, where=is_line, out=np.ones(len(J)))
    whitened, other = J[:, 0], J[:, 1]
    poles = np.stack(
        [
            (whitened + other) / (2.0 * shift[:, None]),
            (whitened - other) / (2.0 * turn[:, None]),
            J[:, 2] / along_px[:, None],
            J[:, 3] / along_px[:, None],
        ],
        axis=1,
    )
    return np.where(is_line[:, None, None], poles, J / across_px[:, None, None])


def _together(given: StreetLabels) -> set[frozenset[int]]:
    """Pairs of landmarks that one image shows."""
    images = defaultdict(set)
    for row in given.labels.observations.values():
        images[row.frame_index, row.side].add(given.truth[row.id].element_id)
    return {frozenset((a, b)) for seen in images.values() for a in seen for b in seen if a != b}


def compare(seeds: Sequence[int]) -> None:
    """Linked beside DBSCAN, for each way of labelling; no identity over frames."""
    for case in CASES:
        ways: dict[str, Way] = {"linked": BuildOptions(case.sigma_px, min_frames=case.min_frames)}
        for eps_m in EPS_M:
            paper = PaperOptions(eps_m, case.min_frames, case.sigma_px)
            ways[f"paper, eps {eps_m} m"] = paper
        tables(f"{case.name}, each frame by itself", case, seeds, ways)


def identity(seeds: Sequence[int]) -> None:
    """People know who is who for twelve frames; then also with four mistakes a street."""
    case = CASES[0]
    ways: dict[str, Way] = {
        "linked": BuildOptions(case.sigma_px),
        "paper, eps 0.5 m": PaperOptions(0.5, 1, case.sigma_px),
    }
    tables(f"{case.name}, identity for 12 frames", case, seeds, ways, memory=12)
    what = f"{case.name}, identity for 12 frames, 4 mistakes a street"
    tables(what, case, seeds, ways, memory=12, mistakes=4)


def two_passes(seeds: Sequence[int]) -> None:
    """The same street twice, the second time with poses that drift."""
    case = CASES[0]
    for drift_m in (0.1, 0.3):
        poses = RefineOptions(pose_sigma_m=drift_m)
        ways: dict[str, Way] = {
            "linked, pose sigma 0.05 m": BuildOptions(case.sigma_px),
            "linked, pose sigma 0.2 m": BuildOptions(case.sigma_px, pose_sigma_m=0.2),
            "the same, poses refined": BuildOptions(case.sigma_px, pose_sigma_m=0.2, refine=poses),
            "paper, eps 0.5 m": PaperOptions(0.5, 1, case.sigma_px),
        }
        what = f"{case.name}, each frame by itself, poses of a second pass off by {drift_m} m"
        tables(what, case, seeds, ways, drift_m=drift_m)


def tables(
    what: str,
    case: Case,
    seeds: Sequence[int],
    ways: dict[str, Way],
    memory: int = 1,
    mistakes: int = 0,
    drift_m: float = 0.0,
) -> None:
    """One table, a line for each way to build maps."""
    print(f"\n{what}: {len(seeds)} streets of 60 frames\n{HEAD}")
    scores = {name: Score() for name in ways}
    for seed in seeds:
        street = street_of(seed)
        source: Dataset = street
        see, frames = case.detect(street, seed), range(60)
        if drift_m:
            twice = DrivenTwice(street, drift_m, seed)
            source, frames = twice, range(120)
            see = twice.seen_by(see, case.detect(street, seed + 10_000))
        given = label_street(see, frames, memory)
        judge = Judge.of(street, given, source, case.shift_px)
        if mistakes:
            given, _ = with_mistakes(given, mistakes, seed)
        for name, way in ways.items():
            scores[name].add(judge.score(build_map(given.labels, source, way)[0]))
    for name, score in scores.items():
        print(f"{name:<36}{score}", flush=True)


# -- a long drive


def big(frames: int) -> None:
    """In processes of their own, so that memory is that of the build."""
    for memory, what in ((1, "each frame by itself"), (frames, "identity given")):
        code = f"import mapping; mapping.build_long({frames}, {memory}, {what!r})"
        folder = Path(__file__).parent
        subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)


def build_long(frames: int, memory: int, what: str) -> None:
    road = Road(frames)
    labels = label_street(road.see, range(frames), memory).labels
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    start, busy = time.perf_counter(), time.process_time()
    built, _ = build_map(labels, road, BuildOptions(0.5))
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{frames} frames, {len(labels.observations)} observations, {what}: {len(built)} elements "
        f"of {len(road.things)} things in {seconds:.1f} s ({busy:.1f} s of processor), "
        f"{peak:.2f} GB (labels alone {before:.2f} GB)",
        flush=True,
    )


def big_detections(frames: int) -> None:
    """One and two cameras, in processes of their own."""
    for sides in (("left",), ("left", "right")):
        code = f"import mapping; mapping.build_detected({frames}, {sides!r})"
        folder = Path(__file__).parent
        subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)


RECALL, FALSE = 0.7, 4.0


def build_detected(frames: int, sides: Sequence[Side]) -> None:
    build_map(Labels(), Road(60), detections=detections_of(Road(60), 60, sides)[0])  # compile
    road = Road(frames)
    detections, truth = detections_of(road, frames, sides)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    start, busy = time.perf_counter(), time.process_time()
    built, report = build_map(Labels(), road, detections=detections)
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    of = [
        Counter(truth[name] for name in source.observation_ids).most_common(1)[0][0]
        for source in built.provenance
    ]
    seen = Counter(thing for thing in truth.values() if thing >= 0)
    possible = [thing for thing, count in seen.items() if count >= 6]
    found = set(of) & set(possible)
    print(
        f"{frames} frames, {len(sides)} camera(s), {len(detections)} detections: {len(built)} "
        f"elements, {len(found) / len(possible):.2%} of {len(possible)} things found, "
        f"{len(of) - len(set(of) - {-1}) - of.count(-1)} twice, {of.count(-1)} false, in "
        f"{seconds:.0f} s ({busy:.0f} s of processor), {peak:.2f} GB (detections alone "
        f"{before:.2f} GB)\n{report.detections}",
        flush=True,
    )


def detections_of(
    road: "Road", frames: int, sides: Sequence[Side]
) -> tuple[Proposals, dict[str, int]]:
    """What a detector finds on the road, and what each find is; -1 for nothing."""
    rows: list[Proposal] = []
    truth: dict[str, int] = {}
    for index in range(frames):
        for side in sides:
            rng = np.random.default_rng([index, side == "right", 7])
            seen = road.see(index, side)
            found = np.flatnonzero(rng.random(len(seen.element_id)) < RECALL)
            images = [seen.observed[found], _nothing(rng)]
            ids = [seen.element_id[found], np.full(len(images[1]), -1)]
            for elements, things in zip(images, ids, strict=True):
                inside = road.rig.left.contains(elements.anchor_px)
                inside &= ~elements.is_line | road.rig.left.contains(elements.end_px)
                proposals = as_proposals(index, side, elements[inside], road.rig.left, "bench")
                truth |= zip((row.id for row in proposals), things[inside].tolist(), strict=True)
                rows += proposals
    return Proposals.of(rows), truth


def _nothing(rng: np.random.Generator) -> Elements2D:
    """False detections, anywhere above the road."""
    count = int(rng.poisson(FALSE))
    class_id = rng.choice(4, count, p=[0.6, 0.1, 0.2, 0.1])
    anchor = rng.uniform([5.0, 20.0], [1235.0, 180.0], (count, 2))
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, count), rng.uniform(30.0, 150.0, count)])
    end[class_id != POLE] = np.nan
    return Elements2D.from_ends(anchor, end, class_id, 0.5)


class Road:
    """A straight road, endless if wanted, with ten landmarks in each image and nothing that hides
    them; a ``Dataset``."""

    def __init__(self, frames: int) -> None:
        rng = np.random.default_rng(0)
        self.map_frame = MapFrame("road")
        self.rig = Street(0, StreetOptions(frames=1)).rig
        ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        self.frames = tuple(
            Frame(i, 0.1 * i, Pose(ahead, np.array([float(i), 0.0, 1.65]))) for i in range(frames)
        )
        x = np.arange(NEAR_M, frames + FAR_M, (FAR_M - NEAR_M) / 10.0)
        n = len(x)
        y = rng.choice([-1.0, 1.0], n) * rng.uniform(3.5, 8.0, n)
        self.things = np.column_stack([x + rng.uniform(-1.0, 1.0, n), y, rng.uniform(2.2, 4.5, n)])
        self.class_id = rng.choice(4, n, p=[0.6, 0.1, 0.2, 0.1])

    def image(self, index: int, side: Side) -> ByteImage:
        raise NotImplementedError

    def see(self, index: int, side: Side) -> Detection:
        """Clicks 0.5 px off."""
        rng = np.random.default_rng([index, side == "right"])
        first, last = np.searchsorted(self.things[:, 0], (index + NEAR_M, index + FAR_M))
        ids = np.arange(first, last)
        pose = self.frames[index].T_map_camera
        assert pose is not None
        view = rig_view(self.rig, side, pose.inverse())
        tops = self.things[ids]
        anchor = view.project(tops) + rng.normal(0.0, 0.5, (len(ids), 2))
        end = view.project(tops * [1.0, 1.0, 0.0]) + rng.normal(0.0, 0.5, (len(ids), 2))
        end[self.class_id[ids] != POLE] = np.nan
        return Detection(Elements2D.from_ends(anchor, end, self.class_id[ids], 0.5), ids)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1000, 1040)))
    parser.add_argument("--big", type=int, nargs="?", const=10_000, metavar="FRAMES")
    parser.add_argument("--detections", type=int, nargs="?", const=10_000, metavar="FRAMES")
    options = parser.parse_args()
    if options.big:
        big(options.big)
        return
    if options.detections:
        big_detections(options.detections)
        return
    compare(options.seeds)
    identity(options.seeds)
    two_passes(options.seeds[:6])


if __name__ == "__main__":
    main()

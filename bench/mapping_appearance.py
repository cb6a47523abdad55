"""Could appearance resolve data association where the position in the image hardly does?

    OMP_NUM_THREADS=1 python bench/mapping_appearance.py [--seeds 1000 1001]

Streets as in ``bench/mapping.py``, each frame labelled by itself, and rendered. For each
observation that two landmarks explain, one of them the true one: which landmark does its position
select, and which its appearance? Appearance is compared, by the similarity of
``assist.appearance``, with the nearest unambiguous observation of each landmark, shifted by up to
4 px. "unclear": observations that map building leaves out; "clear": those that it assigns.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import tests_support  # noqa: F401
from mapping import CASES, Case, street_of
from support.street_labels import label_street

from semviz_annotation.assist.appearance import (
    SIMILARITY_WEIGHTS,
    pole_points,
    pole_width,
    sign_half_size,
    sign_points,
    similarity,
)
from semviz_annotation.assist.marked_image import MarkedImage
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.association.candidates import LandmarkPositions
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.shared_observations import nearby_explanations
from semviz_annotation.mapping.association.tracks import Tracks, find_tracks
from semviz_annotation.mapping.build import BuildOptions
from semviz_annotation.mapping.placement.observations import collect_observations
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.simulation.street import Street
from semviz_core.subpixel.sampling import Samples

SHIFTS_PX = np.arange(-4.0, 4.5)
MOST_CLEAR = 12
"""Of a street; rendering takes its time."""


class Doubt(NamedTuple):
    """An observation that two landmarks explain, the true one first."""

    observation: int
    things: tuple[int, int]
    scores: tuple[float, float]
    """Log-likelihood of its place."""
    clear: bool


class Looks:
    """What the landmarks of one street look like."""

    def __init__(self, street: Street, tracks: Tracks, doubtful: set[int]) -> None:
        self._street, self._tracks = street, tracks
        rows = tracks.observations
        self._sure = np.isin(rows.label_row, sorted(doubtful), invert=True)
        self._shot = lru_cache(maxsize=16)(self._rendered)

    def _rendered(self, index: int, side: Side) -> MarkedImage:
        pose = self._street.frames[index].T_map_camera
        assert pose is not None  # a street knows the truth
        view = rig_view(self._street.rig, side, pose.inverse())
        return MarkedImage.of(view, self._street.image(index, side), "centroid")

    def like(self, observation: int, landmark: int) -> float:
        """How like the landmark an observation is, at best; NaN where one cannot tell."""
        gathered, rows = self._tracks.gathered, self._tracks.observations
        asked = gathered.label_rows[observation]
        sure = rows.label_row[self._sure & (rows.landmark == landmark)]
        others = [gathered.label_rows[row] for row in sure.tolist()]
        if not others:
            return np.nan
        known = min(others, key=lambda other: abs(other.frame_index - asked.frame_index))
        there = self._shot(known.frame_index, known.side)
        here = self._shot(asked.frame_index, asked.side)
        ends = [self._ends_px(shot, landmark) for shot in (there, here)]
        if not np.isfinite(ends).all():
            return np.nan
        if asked.end_px is None:
            return self._sign(there, here, *ends, self._kind(observation), landmark)
        return self._pole(there, here, *ends)

    def _kind(self, observation: int) -> int:
        gathered = self._tracks.gathered
        return gathered.elements[gathered.observations.landmark[observation]].class_id

    def _ends_px(self, shot: MarkedImage, landmark: int) -> FloatArray:
        """(2, 2) where a landmark is in an image; twice its middle for signs."""
        placed = self._tracks.placed
        anchor, end = placed.anchor_m[landmark], placed.end_m[landmark]
        return shot.view.project(np.stack([anchor, end if np.isfinite(end[0]) else anchor]))

    def _pole(
        self, there: MarkedImage, here: MarkedImage, known: FloatArray, asked: FloatArray
    ) -> float:
        width = pole_width(there, known)
        scale = float(
            np.linalg.norm(np.diff(asked, axis=0)) / np.linalg.norm(np.diff(known, axis=0))
        )
        looks = [
            here.sample(pole_points(np.add(asked, (u, 0.0)), width * scale)) for u in SHIFTS_PX
        ]
        return best(there.sample(pole_points(known, width)), looks)

    def _sign(
        self,
        there: MarkedImage,
        here: MarkedImage,
        known: FloatArray,
        asked: FloatArray,
        kind: int,
        landmark: int,
    ) -> float:
        half = sign_half_size(there, known[0], DEFAULT_CLASSES[kind])
        middle = self._tracks.placed.anchor_m[landmark][None]
        scale = float(there.view.depth_m(middle)[0] / here.view.depth_m(middle)[0])
        shifts = [np.array([u, v]) for u in SHIFTS_PX[::2] for v in SHIFTS_PX[::2]]
        looks = [here.sample(sign_points(asked[0] + shift, half * scale)) for shift in shifts]
        return best(there.sample(sign_points(known[0], half)), looks)


def best(samples: Samples, others: list[Samples]) -> float:
    return float((similarity(samples, np.stack(others)) @ SIMILARITY_WEIGHTS).max())


def doubts(tracks: Tracks, options: LinkOptions, truth: IntArray) -> Iterator[Doubt]:
    """What two landmarks explain; truth (k,) of the observations that were gathered."""
    views, observations = tracks.gathered.views, tracks.gathered.observations
    kinds = np.array([element.class_id for element in tracks.gathered.elements])
    kind = np.zeros(tracks.observations.count, dtype=np.int64)
    kind[tracks.landmark] = kinds[tracks.nodes.element]
    claims = nearby_explanations(
        views, observations, kinds[observations.landmark], tracks.placed, kind, options
    )
    fits, score = claims.tested(views, observations, LandmarkPositions.of(tracks.placed), options)
    owner = np.full(len(observations), -1)
    owner[tracks.observations.label_row] = tracks.observations.landmark
    held = set(
        zip(tracks.observations.landmark.tolist(), tracks.observations.view.tolist(), strict=True)
    )
    true = main_truth(tracks, truth)
    by_observation: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for row in np.flatnonzero(fits).tolist():
        observation, landmark = int(claims.observation[row]), int(claims.landmark[row])
        if (
            owner[observation] == landmark
            or (landmark, int(observations.view[observation])) not in held
        ):
            by_observation[observation].append((float(score[row]), landmark))
    for observation, found in sorted(by_observation.items()):
        best_two = sorted(found, reverse=True)[:2]
        best_two.sort(key=lambda scored: true[scored[1]] != truth[observation])
        right = [true[landmark] == truth[observation] for _, landmark in best_two]
        used = owner[observation] >= 0
        if right == [True, False] and (used or tracks.unclear[observation]):
            scores, things = zip(*best_two, strict=True)
            yield Doubt(observation, things, scores, used)


def main_truth(tracks: Tracks, truth: IntArray) -> list[int]:
    """(n,) what each landmark mostly is; -2 where it has no observations."""
    rows = tracks.observations
    return [
        Counter(truth[rows.label_row[rows.landmark == landmark]].tolist()).most_common(1)[0][0]
        if rows.seen[landmark]
        else -2
        for landmark in range(rows.count)
    ]


def compare(case: Case, seeds: Sequence[int]) -> None:
    right: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    observations = 0
    build = BuildOptions(case.sigma_px, min_frames=case.min_frames)
    options = LinkOptions(build.place, build.pose_sigma_m, build.min_frames)
    for seed in seeds:
        street = street_of(seed)
        given = label_street(case.detect(street, seed), range(60))
        gathered = collect_observations(given.labels, street)
        truth = np.array(
            [given.truth[observation.id].element_id for observation in gathered.label_rows]
        )
        tracks = find_tracks(given.labels, gathered, options, None, lambda what, done, of: None)
        found = list(doubts(tracks, options, truth))
        looks = Looks(street, tracks, {pick.observation for pick in found})
        clear = [pick for pick in found if pick.clear]
        observations += len(truth)
        chosen = clear[:: max(1, len(clear) // MOST_CLEAR)]
        for pick in [*chosen, *(pick for pick in found if not pick.clear)]:
            like = [looks.like(pick.observation, landmark) for landmark in pick.things]
            if np.isfinite(like).all():
                count = right[pick.clear]
                count["of"] += 1
                count["place"] += pick.scores[0] > pick.scores[1]
                count["look"] += like[0] > like[1]
    print(f"{case.name}: {len(seeds)} streets, {observations} sightings")
    for is_clear, name in ((True, "clear (a sample)"), (False, "unclear")):
        count = right[is_clear]
        of = max(count["of"], 1)
        print(
            f"  {name:<17}{count['of']:4d}   right by place {count['place'] / of:5.0%}"
            f"   by look {count['look'] / of:5.0%}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1000, 1010)))
    seeds = parser.parse_args().seeds
    for case in CASES[1:]:
        compare(case, seeds)


if __name__ == "__main__":
    main()

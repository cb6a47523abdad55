"""Whether looks could tell whose a sighting is, where its place in the image hardly does.

    OMP_NUM_THREADS=1 python bench/mapping_looks.py [--seeds 1000 1001]

Streets as in ``bench/mapping.py``, each frame labelled by itself, and rendered. Of each sighting
that two things explain, one of which it is truly of: to which of them does its place say that it
belongs, and to which its look? The look is compared, by the likeness that following uses, with the
nearest sight of each thing that nothing else explains; shifted by up to 4 px, since detectors are
off. "unclear": those that map building leaves out; "clear": those that it decides.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from mapping import CASES, Case, street_of

from semviz_annotation.assist.look import (
    LIKENESS,
    half_of,
    likeness,
    pole_points,
    sign_points,
    width_of,
)
from semviz_annotation.assist.shot import Shot
from semviz_annotation.mapping.linking.agreement import Places
from semviz_annotation.mapping.linking.claims import claims_near
from semviz_annotation.mapping.linking.rounds import LinkOptions
from semviz_annotation.mapping.linking.tracks import Tracks, find_tracks
from semviz_annotation.mapping.options import BuildOptions
from semviz_annotation.mapping.placing.sightings import gather
from semviz_annotation.street_labels import label_street
from semviz_annotation.view import rig_view
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.classes import DEFAULT_CLASSES
from semviz_core.measuring.picture import Samples
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street

SHIFTS_PX = np.arange(-4.0, 4.5)
MOST_CLEAR = 12
"""Of a street; rendering takes its time."""


class Doubt(NamedTuple):
    """A sighting that two things explain, the true one first."""

    sighting: int
    things: tuple[int, int]
    scores: tuple[float, float]
    """Log-likelihood of its place."""
    clear: bool


class Looks:
    """What the things of one street look like."""

    def __init__(self, street: Street, tracks: Tracks, doubtful: set[int]) -> None:
        self._street, self._tracks = street, tracks
        rows = tracks.sightings
        self._sure = np.isin(rows.observation, sorted(doubtful), invert=True)
        self._shot = lru_cache(maxsize=16)(self._rendered)

    def _rendered(self, index: int, side: Side) -> Shot:
        pose = self._street.frames[index].T_map_camera
        assert pose is not None  # a street knows the truth
        view = rig_view(self._street.rig, side, pose.inverse())
        return Shot.of(view, self._street.image(index, side))

    def like(self, sighting: int, thing: int) -> float:
        """How like the thing a sighting is, at best; NaN where one cannot tell."""
        gathered, rows = self._tracks.gathered, self._tracks.sightings
        asked = gathered.observations[sighting]
        sure = rows.observation[self._sure & (rows.thing == thing)]
        others = [gathered.observations[row] for row in sure.tolist()]
        if not others:
            return np.nan
        known = min(others, key=lambda one: abs(one.frame_index - asked.frame_index))
        there = self._shot(known.frame_index, known.side)
        here = self._shot(asked.frame_index, asked.side)
        ends = [self._ends_px(shot, thing) for shot in (there, here)]
        if not np.isfinite(ends).all():
            return np.nan
        if asked.end_px is None:
            return self._sign(there, here, *ends, self._kind(sighting), thing)
        return self._pole(there, here, *ends)

    def _kind(self, sighting: int) -> int:
        gathered = self._tracks.gathered
        return gathered.elements[gathered.sightings.thing[sighting]].class_id

    def _ends_px(self, shot: Shot, thing: int) -> FloatArray:
        """(2, 2) where a thing is in an image; twice its middle for signs."""
        placed = self._tracks.placed
        anchor, end = placed.anchor_m[thing], placed.end_m[thing]
        return shot.view.project(np.stack([anchor, end if np.isfinite(end[0]) else anchor]))

    def _pole(self, there: Shot, here: Shot, known: FloatArray, asked: FloatArray) -> float:
        width = width_of(there, known)
        scale = float(
            np.linalg.norm(np.diff(asked, axis=0)) / np.linalg.norm(np.diff(known, axis=0))
        )
        looks = [
            here.sample(pole_points(np.add(asked, (u, 0.0)), width * scale)) for u in SHIFTS_PX
        ]
        return best(there.sample(pole_points(known, width)), looks)

    def _sign(
        self, there: Shot, here: Shot, known: FloatArray, asked: FloatArray, kind: int, thing: int
    ) -> float:
        half = half_of(there, known[0], DEFAULT_CLASSES[kind])
        middle = self._tracks.placed.anchor_m[thing][None]
        scale = float(there.view.depth_m(middle)[0] / here.view.depth_m(middle)[0])
        shifts = [np.array([u, v]) for u in SHIFTS_PX[::2] for v in SHIFTS_PX[::2]]
        looks = [here.sample(sign_points(asked[0] + shift, half * scale)) for shift in shifts]
        return best(there.sample(sign_points(known[0], half)), looks)


def best(one: Samples, others: list[Samples]) -> float:
    return float((likeness(one, np.stack(others)) @ LIKENESS).max())


def doubts(tracks: Tracks, options: LinkOptions, truth: IntArray) -> Iterator[Doubt]:
    """What two things explain; truth (k,) of the sightings that were gathered."""
    views, sightings = tracks.gathered.views, tracks.gathered.sightings
    kinds = np.array([one.class_id for one in tracks.gathered.elements])
    kind = np.zeros(tracks.sightings.count, dtype=np.int64)
    kind[tracks.thing] = kinds[tracks.nodes.element]
    claims = claims_near(views, sightings, kinds[sightings.thing], tracks.placed, kind, options)
    fits, score = claims.tested(views, sightings, Places.of(tracks.placed), options)
    owner = np.full(len(sightings), -1)
    owner[tracks.sightings.observation] = tracks.sightings.thing
    held = set(zip(tracks.sightings.thing.tolist(), tracks.sightings.view.tolist(), strict=True))
    true = main_truth(tracks, truth)
    by_sighting: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for row in np.flatnonzero(fits).tolist():
        sighting, thing = int(claims.sighting[row]), int(claims.thing[row])
        if owner[sighting] == thing or (thing, int(sightings.view[sighting])) not in held:
            by_sighting[sighting].append((float(score[row]), thing))
    for sighting, found in sorted(by_sighting.items()):
        best_two = sorted(found, reverse=True)[:2]
        best_two.sort(key=lambda one: true[one[1]] != truth[sighting])
        right = [true[thing] == truth[sighting] for _, thing in best_two]
        used = owner[sighting] >= 0
        if right == [True, False] and (used or tracks.unclear[sighting]):
            scores, things = zip(*best_two, strict=True)
            yield Doubt(sighting, things, scores, used)


def main_truth(tracks: Tracks, truth: IntArray) -> list[int]:
    """(n,) what each thing mostly is; -2 where it has no sightings."""
    rows = tracks.sightings
    return [
        Counter(truth[rows.observation[rows.thing == thing]].tolist()).most_common(1)[0][0]
        if rows.seen[thing]
        else -2
        for thing in range(rows.count)
    ]


def compare(case: Case, seeds: Sequence[int]) -> None:
    right: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    sightings = 0
    build = BuildOptions(case.sigma_px, min_frames=case.min_frames)
    options = LinkOptions(build.place, build.pose_sigma_m, build.min_frames)
    for seed in seeds:
        street = street_of(seed)
        given = label_street(case.detect(street, seed), range(60))
        gathered = gather(given.labels, street)
        truth = np.array([given.truth[one.id].element_id for one in gathered.observations])
        tracks = find_tracks(given.labels, gathered, options, None, lambda what, done, of: None)
        found = list(doubts(tracks, options, truth))
        looks = Looks(street, tracks, {one.sighting for one in found})
        clear = [one for one in found if one.clear]
        sightings += len(truth)
        chosen = clear[:: max(1, len(clear) // MOST_CLEAR)]
        for one in [*chosen, *(one for one in found if not one.clear)]:
            like = [looks.like(one.sighting, thing) for thing in one.things]
            if np.isfinite(like).all():
                count = right[one.clear]
                count["of"] += 1
                count["place"] += one.scores[0] > one.scores[1]
                count["look"] += like[0] > like[1]
    print(f"{case.name}: {len(seeds)} streets, {sightings} sightings")
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

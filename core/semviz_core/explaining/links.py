"""The method's chain, link by link: each says how it broke, or None.

Seen enough? In the submap? Right pairs possible, and put first? Found by the search? Refined to
the right place? Fixed by the geometry? Links compare with the truth where it is known.
"""

from collections.abc import Sequence

import numpy as np

from semviz_core.explaining.case import Case, apart
from semviz_core.explaining.faults import sound_pairs
from semviz_core.explaining.told import Evidence, Fault, Kind
from semviz_core.localize import NEEDED_ELEMENTS
from semviz_core.pose import Pose
from semviz_core.solving.residuals import scene_residuals
from semviz_core.solving.scene import Scene
from semviz_core.solving.search import APART_M, APART_RAD, BASIN_M, mode_near
from semviz_core.solving.upright import assumed_upright
from semviz_core.solving.verdict import AMBIGUOUS_NATS

MATRIX_FROM_POSES = ("search", "track")
"""Methods whose probabilities follow from the poses found, and so cannot have misled them."""
FAR_OFF_SIGMAS = 4.0
"""A prior is called wrong beyond this many of its own sigmas."""
LEAST_FIRST = 0.5
"""With a smaller share of true pairs among as many put first, the matches were wrong."""
MISSED_NATS = 3.0
"""By more, a pose that was not found explains the image better than the best found."""
MUCH_CLUTTER = 0.5
"""Share of false rows that does harm even where none of them is in the answer."""
STRANGER: Kind = "false or not mapped"
"""Costs a pair if it is of something real; where enough is seen without, that is no failure."""
COSTS_A_PAIR: tuple[Kind, ...] = (
    "wrong class", "moved in the map", "missing in the map", STRANGER,
)  # fmt: skip
NAMED = 3
"""So many elements that were not seen are named."""
_AHEAD_SHARE = 0.23
"""Of all around, so much is in an image of about 80 deg."""


def seen_enough(case: Case) -> Fault | None:
    seen = len(case.localization.observed)
    return None if seen >= NEEDED_ELEMENTS else _too_few(case, seen)


def in_submap(case: Case) -> Fault | None:
    """Whether the solver was given what is seen; a fix far off, or a narrow crop, takes it away."""
    one = case.localization
    if case.reference is None:
        return None if _lost_pairs(case) else _nothing_fits(case)
    sound = sound_pairs(case)
    outside = int((~case.in_submap[sound[:, 1]]).sum()) if len(sound) else 0
    off_m = _prior_off_m(case)
    far_off = off_m > FAR_OFF_SIGMAS * one.prior.horizontal_sigma_m
    enough = len(sound) - outside >= NEEDED_ELEMENTS
    if not far_off and (enough or not outside):
        return None
    evidence = (Evidence("prior off", off_m, "m"), Evidence("outside", outside))
    prior = f"the prior is {off_m:.0f} m off, {off_m / one.prior.horizontal_sigma_m:.1f} sigma"
    sentence = f"{outside} of {len(sound)} mapped elements seen are outside the submap; {prior}."
    return Fault("not in the submap", sentence, evidence)


def _nothing_fits(case: Case) -> Fault:
    """Without any pose: enough is seen, but nothing that was given explains it."""
    one = case.localization
    mapped, poses = len(one.submap), 0 if one.search is None else len(one.search.score)
    sentence = f"{len(one.observed)} elements are seen, and nothing of the submap fits them."
    return Fault(
        "not in the submap", sentence, (Evidence("mapped", mapped), Evidence("poses", poses))
    )


def pairs_possible(case: Case, noticed: Sequence[Fault]) -> Fault | None:
    """Whether enough is seen as it is mapped, and no false row or element is in the answer."""
    if case.reference is None:
        return None
    costly = [one for one in noticed if one.kind in COSTS_A_PAIR]
    sound = len(sound_pairs(case))
    if sound < NEEDED_ELEMENTS and sound + len(costly) < NEEDED_ELEMENTS and case.truth is not None:
        return _too_few(case, sound)
    blamed = [one for one in costly if sound < NEEDED_ELEMENTS or one.kind != STRANGER]
    if blamed:
        return blamed[0]
    used = case.localization.refinement
    rows = set() if used is None else set(used.pairs[used.inlier, 0].tolist())
    cluttered = len(noticed) >= MUCH_CLUTTER * len(case.localization.observed)
    harmful = [
        one for one in noticed
        if one.kind == "twice in the map" or cluttered or rows & set(one.rows)
    ]  # fmt: skip
    return harmful[0] if harmful else None


def matched(case: Case) -> Fault | None:
    """Whether the pairs that the solver preferred were the true ones."""
    one = case.localization
    if case.truth is None or one.match is None or one.method in MATRIX_FROM_POSES:
        return None
    sound = sound_pairs(case)
    true = {(int(i), int(case.nearby.id[j])) for i, j in sound}
    order = [(int(i), int(one.submap.id[j])) for i, j in one.match.order]
    if not true:
        return None
    first = len(true.intersection(order[: len(true)])) / len(true)
    if first >= LEAST_FIRST:
        return None
    ranks = [order.index(pair) + 1 if pair in order else len(order) + 1 for pair in sorted(true)]
    rank = float(np.median(ranks))
    sentence = (
        f"Of the {len(true)} pairs put first, {first:.0%} are true; the true ones are at rank "
        f"{rank:.0f} in the middle."
    )
    evidence = (Evidence("true among the first", first), Evidence("median rank", rank))
    return Fault("wrong matches", sentence, evidence)


def searched(case: Case) -> Fault | None:
    """Whether the true pose was found, and preferred."""
    found = case.localization.search
    if case.truth is None or found is None:
        return None
    if found_truth(case):
        return None
    best = float(found.score[0]) if len(found.score) else -np.inf
    truth = score_near(case, case.truth)
    evidence = (Evidence("truth", truth, "nats"), Evidence("best found", best, "nats"))
    if truth > best + MISSED_NATS and not any(map(case.is_true, found.T_camera_map)):
        sentence = f"The true pose explains the image with {truth:.0f} nats and was not found"
        worse = f"; the best found has {best:.0f}." if len(found.score) else "."
        return Fault("search miss", sentence + worse, evidence)
    sentence = (
        f"Another pose explains the image better than the true one, by {best - truth:.1f} nats."
    )
    return Fault("ambiguous geometry", sentence, evidence)


def found_truth(case: Case) -> bool:
    """Whether the search liked the true pose best; False where that is not known."""
    found = case.localization.search
    return found is not None and len(found.score) > 0 and case.is_true(found.T_camera_map[0])


def refined(case: Case) -> Fault | None:
    """Whether the answer is near where refinement started."""
    one = case.localization
    if one.search is None or not len(one.search.score):
        return None
    if one.T_camera_map is None:
        return _lost_pairs(case)
    away_m, angle = apart(one.search.T_camera_map[0], one.T_camera_map)
    limit_m = BASIN_M if case.truth is None else APART_M
    if away_m <= limit_m and angle <= 2.0 * APART_RAD:
        return None
    sentence = f"Refinement ended {away_m:.1f} m and {np.rad2deg(angle):.0f} deg from its start."
    return Fault("refinement diverged", sentence, (Evidence("away", away_m, "m"),))


def _lost_pairs(case: Case) -> Fault | None:
    """Where pairs fit the pose that refinement started from, and no longer the one it ended at."""
    one = case.localization
    if one.search is None or not one.search.T_camera_map or one.refinement is None:
        return None
    pairs, after = one.refinement.pairs, int(one.refinement.inlier.sum())
    scene = Scene.of(one.camera, one.observed, one.submap, case.detector)
    before = int(scene_residuals(scene, one.search.T_camera_map[0], pairs).inlier.sum())
    if before < NEEDED_ELEMENTS or after >= before:
        return None
    sentence = f"{before} pairs fitted where refinement started, {after} where it ended."
    evidence = (Evidence("fit before", before), Evidence("fit after", after))
    return Fault("refinement diverged", sentence, evidence)


def fixed(case: Case) -> Fault | None:
    """Whether the pairs fix one pose; asked last, of frames without a sure answer."""
    one = case.localization
    if one.status == "ok":
        return None
    rivals = 0
    if one.search is not None and len(one.search.score):
        rivals = int((one.search.score[0] - one.search.score < AMBIGUOUS_NATS).sum())
    if rivals > 1:
        gap = float(one.search.score[0] - one.search.score[1]) if one.search else 0.0
        sentence = f"What is in view looks alike from {rivals} places."
        evidence = (Evidence("poses", rivals), Evidence("gap", gap, "nats"))
        return Fault("ambiguous geometry", sentence, evidence)
    sigma_m = np.nan
    if one.covariance is not None:
        sigma_m = float(np.sqrt(np.trace(one.covariance[:3, :3])))
    sentence = "What is seen fixes no pose for sure, as it stands."
    return Fault("ambiguous geometry", sentence, (Evidence("uncertainty", sigma_m, "m"),))


def score_near(case: Case, T_camera_map: Pose) -> float:
    """Log-likelihood (nats) of the best pose near one, as the search would have scored it."""
    one = case.localization
    scene = Scene.of(one.camera, one.observed, one.submap, case.detector)
    return float(mode_near(scene, assumed_upright(one.prior), T_camera_map).score[0])


def _too_few(case: Case, seen: int) -> Fault:
    """Whose fault it is that little is seen: the place's, or the detector's."""
    if case.truth is not None:
        mapped, about = int(case.in_view.sum()), ""
    else:
        mapped, about = round(_AHEAD_SHARE * _within_reach(case)), "about "
    kind: Kind = "missed detection" if mapped >= NEEDED_ELEMENTS else "too few elements"
    sentence = (
        f"{about}{mapped} mapped elements are in view, {seen} of them seen; "
        f"{NEEDED_ELEMENTS} are needed.{_unseen(case)}"
    )
    evidence = (Evidence("seen", seen), Evidence("in view", mapped))
    return Fault(kind, sentence[0].upper() + sentence[1:], evidence)


def _unseen(case: Case) -> str:
    """The elements in view that were not seen, by name, the nearest first."""
    missed = np.flatnonzero(case.missed)
    if case.truth is None or not len(missed):
        return ""
    depth_m = case.truth.apply(case.nearby.anchor_m[missed])[:, 2]
    names = [case.name(int(j)) for j in missed[np.argsort(depth_m)]]
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f" Not seen: {', '.join(names[:NAMED])}{more}."


def _within_reach(case: Case) -> int:
    """Mapped elements about the prior that a camera there could see, turned whichever way."""
    one = case.localization
    offset_m = one.submap.anchor_m[:, :2] - one.prior.position_m[:2]
    return int((np.linalg.norm(offset_m, axis=1) < case.detector.far_m).sum())


def _prior_off_m(case: Case) -> float:
    assert case.reference is not None
    center_m = case.reference.inverse().translation
    return float(np.linalg.norm((case.localization.prior.position_m - center_m)[:2]))

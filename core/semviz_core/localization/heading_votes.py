"""Propose upright poses: positions around the prior, each with the headings voted for there.

At a position the distance of every mapped element is known, so its height selects the observed
elements it can be. Each such match votes for the headings that make their azimuths agree, with
its gain in nats, and an observed element counts once, with its best match. Peaks of the sum over
headings become candidates. Pairs of matches are no alternative: false ones are a hundred times as
many as true ones. A grid of positions misses no true pose, whatever is hidden, cut off or as high
as the camera. Its runtime is bounded in advance. An Effort limits the search.

Positions are searched in square blocks. Only elements near a block vote there (module `voting`), so
the time does not grow with the map.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.jit import compiled, compiled_leaf
from semviz_core.localization.prior_residuals import road_heights
from semviz_core.localization.problem import PoseProblem, PriorRecord, rows_within
from semviz_core.localization.upright import (
    UprightView,
    elements_in_reach,
    proposing_reach,
    upright_elements,
)
from semviz_core.localization.voting import (
    BIN_RAD,
    BINS,
    FARTHEST_M,
    Float32Array,
    fill_voters,
    room_for_voters,
    vote_at,
    vote_weights,
)


class Effort(NamedTuple):
    """Limits of a search. A view is one assumed direction of up."""

    step_m: float = 3.0
    """Grid step of positions; fits converge from several times as far."""
    polished: int = 100
    """Most candidates refined and rated, per view, behind an ordinary fix; fewer if ``started`` is
    shared."""
    started: int = 16
    """Most candidates paired and fitted once: per view, or over all views if that is more."""
    finished: int = 6
    """Most candidates fitted until they converge."""
    improved: int = 3
    """Most modes fitted again without each of their pairs."""
    hopeful_nats: float = 30.0
    """Candidates further below the best are dropped."""


DEFAULT_EFFORT = Effort()
"""Sufficient for an ordinary GPS fix."""
WIDE = Effort(polished=600, started=64, finished=40, improved=6)
"""Modes for a verifier to choose from, at about twice the runtime."""
OF_COUPLES = Effort(polished=300, started=32, finished=12)
"""For the poses of couples of learned correspondences: they are fewer, and nearer to true ones."""


BLOCK = 3
"""Positions of a square of so many steps share the road's height and the matches nearby."""
GATE_SIGMAS, GATE_WIDER_M = 3.0, 1.0
"""Radius of the search around the fix: so many sigmas plus a margin."""
WIDE_GATE_M, OFF_ROAD_M = 120.0, 30.0
"""If the gate is wider than the first, only positions this near to the road are searched."""
CROWDED, LEAST_STEP_M = 240.0, 1.8
"""With more elements than this within reach, positions are as dense as the elements, down to this
step: else chance matches agree with every heading. In proportion fewer candidates are kept, down
to LEAST_POLISHED: each takes so much longer."""
LEAST_POLISHED = 50
ORDINARY_BLOCKS, MOST_TIMES = 150.0, 6.0
"""In a search of more blocks than the first, up to so many times the candidates are kept."""


class PoseCandidates(NamedTuple):
    """Candidate poses of an upright camera."""

    pose: FloatArray
    """(h, 6) x, y, z, cosine and sine of the heading, and tilt: by how much the camera looks
    further up than the level frame (rad), here 0. Those with the highest votes first."""
    evaluated: int
    """Number of peaks over all positions and headings."""


class _Pool(NamedTuple):
    """The best candidates so far; there is room for more than are wanted."""

    pose: FloatArray  # (room, 6) as in PoseCandidates
    nats: FloatArray  # (room,)


@compiled
def vote_headings(
    problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
) -> PoseCandidates:
    """Return the best candidates within the prior's gates."""
    elements, _ = upright_elements(problem)
    gate = GATE_SIGMAS * prior.value.position_sigma_m[0] + GATE_WIDER_M
    block_m = BLOCK * effort.step_m
    blocks = _blocks(prior, gate, effort.step_m)
    reach_m = min(proposing_reach(problem), FARTHEST_M)
    weights = vote_weights(view, effort.step_m)
    voters = room_for_voters(len(problem.seen), 0)
    wanted = _wanted(problem, effort, int(blocks.sum()))
    room = 4 * wanted + BINS
    pool = _Pool(np.zeros((room, 6)), np.full(room, -np.inf))
    count, evaluated, least, middle = 0, 0, 0.0, len(blocks) // 2
    for block in np.argwhere(blocks):
        x = prior.value.position_m[0] + (block[0] - middle) * block_m
        y = prior.value.position_m[1] + (block[1] - middle) * block_m
        near = rows_within(problem, x, y, reach_m + block_m)
        if len(near) == 0:
            continue
        for z in road_heights(prior, x, y):
            if voters.value.shape[1] < len(problem.seen) * len(near):
                voters = room_for_voters(len(problem.seen), 2 * len(problem.seen) * len(near))
            fill_voters(
                problem.setting, view, elements, problem.compatible, near, (x, y, z), weights,
                voters,
            )  # fmt: skip
            for cell in range(BLOCK * BLOCK):
                east = (cell % BLOCK - BLOCK // 2) * effort.step_m
                north = (cell // BLOCK - BLOCK // 2) * effort.step_m
                cell_x, cell_y = x + east, y + north
                dx, dy = cell_x - prior.value.position_m[0], cell_y - prior.value.position_m[1]
                if dx * dx + dy * dy > gate * gate:
                    continue
                vote_at(voters, weights, east, north, reach_m)
                of_prior = -0.5 * (dx * dx + dy * dy) / prior.value.position_sigma_m[0] ** 2
                added = _keep_peaks(
                    prior, (cell_x, cell_y, z), of_prior, least, voters.total, pool, count
                )
                count, evaluated = count + added, evaluated + added
                if count + BINS > room:
                    count = _keep_best(pool, count, wanted)
                    least = pool.nats[count - 1]
    count = _keep_best(pool, count, wanted)
    return PoseCandidates(pool.pose[:count].copy(), evaluated)


@compiled
def _wanted(problem: PoseProblem, effort: Effort, blocks: int) -> int:
    """Return how many candidates to keep: more among many positions, where more are false, and
    fewer in a crowded map."""
    more = min(max(np.sqrt(blocks / ORDINARY_BLOCKS), 1.0), MOST_TIMES)
    fewer = max(elements_in_reach(problem) / CROWDED, 1.0)
    return int(more * max(effort.polished / fewer, min(LEAST_POLISHED, effort.polished)))


@compiled
def grid_step(problem: PoseProblem, step_m: float) -> float:
    """Return the grid step for the map's density: ``step_m``, or less in a crowded map."""
    crowded = elements_in_reach(problem) / CROWDED
    return step_m if crowded <= 1.0 else max(step_m / np.sqrt(crowded), min(LEAST_STEP_M, step_m))


@compiled
def _blocks(prior: PriorRecord, gate: float, step_m: float) -> BoolArray:
    """Return which blocks (2k + 1, 2k + 1), by column and row, to search: those with a position
    within the gate, and of a wide gate only those near the road, if it is known."""
    block_m = BLOCK * step_m
    k = int(gate / block_m) + 1
    blocks = np.zeros((2 * k + 1, 2 * k + 1), dtype=np.bool_)
    if gate < WIDE_GATE_M or not len(prior.road_m):
        for column in range(-k, k + 1):
            for row in range(-k, k + 1):
                east = max(BLOCK * abs(column) - BLOCK // 2, 0)
                north = max(BLOCK * abs(row) - BLOCK // 2, 0)
                blocks[column + k, row + k] = np.hypot(east, north) * step_m <= gate
        return blocks
    reach = int(np.ceil(OFF_ROAD_M / block_m))
    for point in prior.road_m:
        column = int(np.round((point[0] - prior.value.position_m[0]) / block_m)) + k
        row = int(np.round((point[1] - prior.value.position_m[1]) / block_m)) + k
        blocks[
            max(column - reach, 0) : max(column + reach + 1, 0),
            max(row - reach, 0) : max(row + reach + 1, 0),
        ] = True
    return blocks


@compiled_leaf
def _keep_peaks(
    prior: PriorRecord,
    position_m: tuple[float, float, float],
    of_prior: float,
    least: float,
    total: Float32Array,
    pool: _Pool,
    count: int,
) -> int:
    """Add the peaks over headings with more than ``least`` nats to the pool from row ``count`` on;
    return how many were added."""
    added = 0
    for bin in range(BINS):
        nats = total[bin]
        after = total[bin + 1 if bin + 1 < BINS else 0]
        if nats + of_prior <= least or nats < total[bin - 1] or nats <= after or nats <= 0.0:
            continue
        heading = (bin + 0.5) * BIN_RAD
        if heading_allowed(prior, heading):
            row = pool.pose[count + added]
            row[0], row[1], row[2] = position_m
            row[3], row[4] = np.cos(heading), np.sin(heading)
            pool.nats[count + added] = nats + of_prior
            added += 1
    return added


@compiled
def _keep_best(pool: _Pool, count: int, wanted: int) -> int:
    """Move the best candidates, at most ``wanted``, to the front; return how many there are."""
    best = np.argsort(-pool.nats[:count], kind="mergesort")[:wanted]
    pool.pose[: len(best)], pool.nats[: len(best)] = pool.pose[best], pool.nats[best]
    return len(best)


@compiled_leaf
def heading_allowed(prior: PriorRecord, heading: float) -> bool:
    """Return whether the prior's heading, if any, allows this one (rad)."""
    if not prior.value.has_heading:
        return True
    off = heading - prior.value.heading_rad
    off = np.arctan2(np.sin(off), np.cos(off))
    return abs(off) <= GATE_SIGMAS * prior.value.heading_sigma_rad + BIN_RAD

"""Propose upright poses: positions around the prior, each with the headings voted for there.

At a position the distance of every mapped element is known, so its height selects the observed
elements it can be. Each such match votes for the headings that make their azimuths agree, with
its gain in nats, and an observed element counts once, with its best match. Peaks of the sum over
headings become candidates. Pairs of matches are no alternative: false ones are a hundred times as
many as true ones. A grid of positions misses no true pose, whatever is hidden, cut off or as high
as the camera. Its runtime is bounded in advance. An Effort limits the search.

Positions are searched in square blocks. Matches that agree nowhere in a block are left out there,
so the time does not grow with the map.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.prior_residuals import road_heights
from semviz_core.localization.problem import (
    PoseProblem,
    PriorRecord,
    Record,
    RecordArray,
    rows_within,
)
from semviz_core.localization.upright import (
    FALSE_SLOPE,
    FALSE_TURN,
    HIDDEN_CHI2,
    UprightView,
    elements_in_reach,
    proposing_reach,
    upright_elements,
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
"""Positions of a square of so many steps share the road's height and the matches that agree."""
GATE_SIGMAS, GATE_WIDER_M = 3.0, 1.0
"""Radius of the search around the fix: so many sigmas plus a margin."""
WIDE_GATE_M, OFF_ROAD_M = 120.0, 30.0
"""If the gate is wider than the first, only positions this near to the road are searched."""
NEAREST_M, FARTHEST_M = 2.5, 60.0
BINS = 180
"""Bins of the heading, two degrees each."""
AGREEING_SIGMAS = 3.3
"""Matches whose slopes differ by more do not vote."""
STEP_SIGMAS, HEIGHT_SIGMA_M, HEADING_SIGMA_RAD = 1.0 / 6.0, 0.15, float(np.deg2rad(0.8))
"""Sigmas of a position, as a share of the grid step, of its height, and of a heading."""
MOST_SIGMAS = 3.0
"""A vote spreads at most so far."""
CROWDED, LEAST_STEP_M = 150.0, 1.8
"""With more elements than this within reach, positions are as dense as the elements, down to this
step: else chance matches agree with every heading."""
ORDINARY_BLOCKS, MOST_TIMES = 150.0, 6.0
"""In a search of more blocks than the first, up to so many times the candidates are kept."""
_FULL_TURN = 2.0 * np.pi
_BIN = _FULL_TURN / BINS

VOTER = np.dtype(
    [
        ("seen", np.int64),
        ("mapped", np.int64),
        ("near", float, (2,)),  # least and largest 1 / distance at which the slopes agree
        ("rise_m", float, (2,)),  # of anchor and end over the camera
        ("slope", float, (2,)),
        ("weight", float, (2,)),  # 1 / variance of the slopes; 0 where not known
        ("gain", float, (2,)),  # nats at best: with its bottom visible, and hidden
    ],
    align=True,
)
"""A match that may agree somewhere in a block."""


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


class _VoteTable(NamedTuple):
    """Working memory of the vote at a position."""

    best: FloatArray  # (m, BINS) the best gain of each observed element for each heading
    total: FloatArray  # (BINS,) their sum


@compiled
def vote_headings(
    problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
) -> PoseCandidates:
    """Return the best candidates within the prior's gates."""
    elements, candidate = upright_elements(problem)
    gate = GATE_SIGMAS * prior.value.position_sigma_m[0] + GATE_WIDER_M
    block_m = BLOCK * effort.step_m
    blocks = _blocks(prior, gate, block_m)
    reach_m = min(proposing_reach(problem), FARTHEST_M)
    table = _VoteTable(np.empty((len(problem.seen), BINS)), np.empty(BINS))
    wanted = _wanted(effort, int(blocks.sum()))
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
            voters = _voters(
                problem.setting, view, prior, elements, candidate, near, (x, y, z), effort.step_m
            )
            for cell in range(BLOCK * BLOCK):
                cell_x = x + (cell % BLOCK - BLOCK // 2) * effort.step_m
                cell_y = y + (cell // BLOCK - BLOCK // 2) * effort.step_m
                dx, dy = cell_x - prior.value.position_m[0], cell_y - prior.value.position_m[1]
                if dx * dx + dy * dy > gate * gate:
                    continue
                _vote(view, elements, voters, cell_x, cell_y, effort.step_m, reach_m, table)
                of_prior = -0.5 * (dx * dx + dy * dy) / prior.value.position_sigma_m[0] ** 2
                added = _keep_peaks(
                    prior, (cell_x, cell_y, z), of_prior, least, table.total, pool, count
                )
                count, evaluated = count + added, evaluated + added
                if count + BINS > room:
                    count = _keep_best(pool, count, wanted)
                    least = pool.nats[count - 1]
    count = _keep_best(pool, count, wanted)
    return PoseCandidates(pool.pose[:count].copy(), evaluated)


@compiled
def _wanted(effort: Effort, blocks: int) -> int:
    """Return how many candidates to keep: more among many positions, where more are false."""
    more = np.sqrt(blocks / ORDINARY_BLOCKS)
    return int(effort.polished * min(max(more, 1.0), MOST_TIMES))


@compiled
def grid_step(problem: PoseProblem, step_m: float) -> float:
    """Return the grid step for the map's density: ``step_m``, or less in a crowded map."""
    crowded = elements_in_reach(problem) / CROWDED
    return step_m if crowded <= 1.0 else max(step_m / np.sqrt(crowded), min(LEAST_STEP_M, step_m))


@compiled
def _blocks(prior: PriorRecord, gate: float, block_m: float) -> BoolArray:
    """Return which blocks (2k + 1, 2k + 1), by column and row, to search: those within the gate,
    and of a wide gate only those near the road, if it is known."""
    k = int(gate / block_m) + 1
    blocks = np.zeros((2 * k + 1, 2 * k + 1), dtype=np.bool_)
    if gate < WIDE_GATE_M or not len(prior.road_m):
        for column in range(-k, k + 1):
            for row in range(-k, k + 1):  # unless all corners are outside the gate
                inside = np.hypot(column, row) * block_m <= gate + block_m
                blocks[column + k, row + k] = inside
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


@compiled
def _voters(
    setting: Record,
    view: UprightView,
    prior: PriorRecord,
    elements: RecordArray,
    candidate: IntArray,
    near: IntArray,
    middle_m: tuple[float, float, float],
    step_m: float,
) -> RecordArray:
    """Return (k,) VOTER of a block around ``middle_m``: the matches of elements in rows ``near``
    whose slopes agree somewhere in it. Matches of an element are successive."""
    room = 0
    for j in near:
        room += elements[j].last - elements[j].first
    voters, count = np.empty(room, VOTER), 0
    x, y, z = middle_m
    block_radius = BLOCK * step_m / np.sqrt(2.0)
    for j in near:
        mapped = elements[j]
        distance = np.hypot(mapped.position_m[0] - x, mapped.position_m[1] - y)
        closest = 1.0 / max(distance - block_radius, NEAREST_M)
        for entry in range(mapped.first, mapped.last):
            i = candidate[entry]
            low, high = _agreeing_range(setting, view, prior, mapped, view.seen[i], z)
            low, high = max(low, 1.0 / (distance + block_radius)), min(high, closest)
            if low > high:
                continue
            voter = voters[count]
            voter.seen, voter.mapped = i, j
            voter.near[0], voter.near[1] = low, high
            at = min(max(1.0 / max(distance, NEAREST_M), low), high)
            _fill_gain(setting, view, mapped, view.seen[i], at, z, step_m, voter)
            count += 1
    return voters[:count]


@compiled
def _agreeing_range(
    setting: Record, view: UprightView, prior: PriorRecord, mapped: Record, seen: Record, z: float
) -> tuple[float, float]:
    """Return the range of 1 / distance at which a match's slopes agree, for a camera at ``z``."""
    low, high = 1.0 / FARTHEST_M, 1.0 / NEAREST_M
    own_variance = seen.slope_sigma**2 + view.up_sigma_rad**2
    for end in range(2):
        if not (seen.known[end] and mapped.known[end]):
            continue
        rise = mapped.height_m[end] - z
        height_sigma = prior.value.position_sigma_m[2] * min(abs(seen.slope[end] / rise), 0.2)
        slack = AGREEING_SIGMAS * np.sqrt(own_variance + height_sigma * height_sigma)
        first, second = (seen.slope[end] - slack) / rise, (seen.slope[end] + slack) / rise
        hidden = end == 1 and setting.hidden_bottoms > 0.0
        if not hidden:
            low, high = max(low, min(first, second)), min(high, max(first, second))
        elif rise < 0.0:  # a hidden bottom ends above the mapped one
            low = max(low, second)
    return low, high


@compiled
def _fill_gain(
    setting: Record,
    view: UprightView,
    mapped: Record,
    seen: Record,
    near: float,
    z: float,
    step_m: float,
    voter: Record,
) -> None:
    """Fill in slopes, weights and gains of a match; sigmas are those at a distance 1 / ``near``."""
    gain = FALSE_TURN
    own_variance = seen.slope_sigma**2 + view.up_sigma_rad**2
    for end in range(2):
        voter.rise_m[end], voter.slope[end] = mapped.height_m[end] - z, seen.slope[end]
        voter.weight[end] = 0.0
        hidden_gain = gain + setting.log_hidden
        if seen.known[end] and mapped.known[end]:
            position = STEP_SIGMAS * step_m * seen.slope[end]
            variance = own_variance + (HEIGHT_SIGMA_M**2 + position * position) * near * near
            voter.weight[end] = 1.0 / variance
            gain += FALSE_SLOPE - 0.5 * np.log(variance)
            if end == 1 and setting.hidden_bottoms > 0.0:
                gain += setting.log_visible
        voter.gain[0] = gain
        voter.gain[1] = hidden_gain


@compiled
def _vote(
    view: UprightView,
    elements: RecordArray,
    voters: RecordArray,
    x: float,
    y: float,
    step_m: float,
    reach_m: float,
    table: _VoteTable,
) -> None:
    """Fill the table at a position; the true one is up to half a ``step_m`` away on either axis."""
    table.best[:], table.total[:] = 0.0, 0.0
    last, near, low, high = -1, 0.0, 0.0, 0.0
    bearing = variance = of_turn = 0.0
    for k in range(len(voters)):
        voter = voters[k]
        if voter.mapped != last:
            last = voter.mapped
            east, north = elements[last].position_m[0] - x, elements[last].position_m[1] - y
            square = east * east + north * north
            if not NEAREST_M**2 < square < reach_m**2:
                low, high = np.inf, -np.inf  # agrees with nothing
                continue
            near = 1.0 / np.sqrt(square)
            slack = 0.5 * step_m * near
            low, high = near * (1.0 - slack), near * (1.0 + slack)
            bearing = _quick_arctan2(north, east)
            variance = (STEP_SIGMAS * step_m * near) ** 2 + HEADING_SIGMA_RAD**2
            of_turn = 0.5 * np.log(variance)
            variance /= _BIN**2
        if voter.near[1] < low or voter.near[0] > high:
            continue
        gain = _gain_at(voter, near) - of_turn
        if gain > 0.0:
            heading = (bearing - view.seen[voter.seen].azimuth_rad) / _BIN
            _add_vote(table.best[voter.seen], table.total, heading, gain, variance)


@compiled
def _gain_at(voter: Record, near: float) -> float:
    """Return the gain of a match's slopes at a distance 1 / ``near``."""
    off = voter.rise_m[1] * near - voter.slope[1]
    chi2 = off * off * voter.weight[1]
    if off < 0.0 and chi2 > HIDDEN_CHI2:
        chi2, gain = 0.0, voter.gain[1]
    else:
        gain = voter.gain[0]
    off = voter.rise_m[0] * near - voter.slope[0]
    return gain - 0.5 * (chi2 + off * off * voter.weight[0])


@compiled
def _add_vote(
    best: FloatArray, total: FloatArray, heading: float, gain: float, variance: float
) -> None:
    """Add a vote for ``heading`` (in bins), which falls off with ``variance`` (bins squared).

    ``best`` (BINS,) is that of the observed element, ``total`` (BINS,) of all.
    """
    spread, weight = np.sqrt(variance * min(2.0 * gain, MOST_SIGMAS**2)), 0.5 / variance
    bin = int(np.ceil(heading - spread - 0.5))
    off, last = bin + 0.5 - heading, spread
    bin += BINS if bin < 0 else 0
    bin -= BINS if bin >= BINS else 0
    while off <= last:
        more = gain - off * off * weight - best[bin]
        if more > 0.0:
            best[bin] += more
            total[bin] += more
        off += 1.0
        bin = bin + 1 if bin + 1 < BINS else 0


@compiled
def _keep_peaks(
    prior: PriorRecord,
    position_m: tuple[float, float, float],
    of_prior: float,
    least: float,
    total: FloatArray,
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
        heading = (bin + 0.5) * _BIN
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


@compiled
def _quick_arctan2(y: float, x: float) -> float:
    """Return arctan2 to 2e-4 rad in a quarter of the time (Abramowitz and Stegun 1964, 4.4.49)."""
    steep = abs(y) > abs(x)
    ratio = min(abs(x), abs(y)) / max(abs(x), abs(y), 1e-300)
    s = ratio * ratio
    angle = ratio * (
        0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351)))
    )
    if steep:
        angle = 0.5 * np.pi - angle
    if x < 0.0:
        angle = np.pi - angle
    return -angle if y < 0.0 else angle


@compiled
def heading_allowed(prior: PriorRecord, heading: float) -> bool:
    """Return whether the prior's heading, if any, allows this one (rad)."""
    if not prior.value.has_heading:
        return True
    off = heading - prior.value.heading_rad
    off = np.arctan2(np.sin(off), np.cos(off))
    return abs(off) <= GATE_SIGMAS * prior.value.heading_sigma_rad + _FULL_TURN / BINS

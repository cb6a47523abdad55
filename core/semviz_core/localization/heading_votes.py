"""Propose upright poses: positions around the prior, each with the headings voted for there.

At a position the distance of every mapped element is known, so its height selects the observed
elements it can be. Each such match votes for the heading that makes their azimuths agree.
Positions and headings with the most distinct voters become candidates. Pairs of matches are no
alternative: false ones are a hundred times as many as true ones. A grid of positions misses no
true pose, whatever is hidden, cut off or as high as the camera. Its runtime is bounded in
advance. An Effort limits the search.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.prior_residuals import road_heights
from semviz_core.localization.problem import PoseProblem, PriorRecord, Record, RecordArray
from semviz_core.localization.upright import UprightView, upright_elements


class Effort(NamedTuple):
    """Limits of a search. A view is one assumed direction of up."""

    step_m: float = 3.6
    """Grid step of positions; fits converge from several times as far."""
    hypotheses: int = 500
    """Most candidates rated, per view."""
    polished: int = 150
    """Most candidates refined and rated again, per view; fewer if ``started`` is shared."""
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
WIDE = Effort(hypotheses=1200, polished=600, started=64, finished=40, improved=6)
"""Includes the true pose for a fix 50 m off, in clutter or without gravity, at about twice the
runtime. The true pose need not score best."""
OF_COUPLES = Effort(polished=300, started=32, finished=12)
"""For the poses of couples of learned correspondences: they are fewer, and nearer to true ones."""


BLOCK = 3
"""Positions of a square of so many steps share the road's height and the ranges it implies."""
GATE_SIGMAS, GATE_WIDER_M = 3.0, 1.0
"""Radius of the search around the fix: so many sigmas plus a margin."""
NEAREST_M, FARTHEST_M = 2.5, 60.0
BINS = 180
"""Bins of the heading, two degrees each."""
VOTE_SPREAD_RAD = float(np.deg2rad(1.0))
"""A vote spreads at least so far to either side."""
AGREEING_SIGMAS = 3.3
"""Matches whose slopes differ by more do not vote."""
RUNS = 3
"""Most headings kept per position: those with the most voters, and with one less."""
LEAST_VOTERS = 2
MOST_VOTERS = 60
"""Most observed elements that vote: one bit each of a 64-bit integer."""
_FULL_TURN = 2.0 * np.pi


class PoseCandidates(NamedTuple):
    """Candidate poses of an upright camera."""

    pose: FloatArray
    """(h, 6) x, y, z, cosine and sine of the heading, and tilt: by how much the camera looks
    further up than the level frame (rad), here 0. Those with the most voters first."""
    evaluated: int
    """Number of positions and headings with enough voters."""


class _VoteTable(NamedTuple):
    """Working memory of the vote, and its results."""

    ranges: FloatArray  # (p, 2) least and largest 1 / distance at which a match agrees
    votes: IntArray  # (BINS,) for each heading, a bit for each observed element that agrees
    number: IntArray  # (BINS,) number of bits set
    pose: FloatArray  # (room, 6) as in PoseCandidates
    voters: IntArray  # (room,)
    level: IntArray  # number of poses by number of voters


@compiled
def vote_headings(
    problem: PoseProblem, view: UprightView, prior: PriorRecord, effort: Effort
) -> PoseCandidates:
    """Return the candidates within the prior's gates."""
    elements, candidate = upright_elements(problem)
    gate = GATE_SIGMAS * prior.value.position_sigma_m[0] + GATE_WIDER_M
    block_m = BLOCK * effort.step_m
    blocks = int(gate / block_m) + 1
    room = ((2 * blocks + 1) * BLOCK) ** 2 * RUNS
    table = _VoteTable(
        np.empty((len(candidate), 2)),
        np.zeros(BINS, dtype=np.int64),
        np.zeros(BINS, dtype=np.int64),
        np.zeros((room, 6)),
        np.empty(room, dtype=np.int64),
        np.zeros(MOST_VOTERS + 2, dtype=np.int64),
    )
    count = 0
    for column in range(-blocks, blocks + 1):
        for row in range(-blocks, blocks + 1):
            if np.hypot(column, row) * block_m > gate + block_m:
                continue  # a corner outside the gate
            x = prior.value.position_m[0] + column * block_m
            y = prior.value.position_m[1] + row * block_m
            for z in road_heights(prior, x, y):
                _fill_ranges(problem.setting, view, prior, elements, candidate, z, table.ranges)
                count = _vote_in_block(
                    view, prior, elements, candidate, gate, x, y, z, table, effort, count
                )
    return PoseCandidates(table.pose[_most_voted(table.voters[:count], effort.hypotheses)], count)


@compiled
def _fill_ranges(
    setting: Record,
    view: UprightView,
    prior: PriorRecord,
    elements: RecordArray,
    candidate: IntArray,
    z: float,
    ranges: FloatArray,
) -> None:
    """Fill the range of 1 / distance at which each match's slopes agree, for a camera at ``z``."""
    for j in range(len(elements)):
        for entry in range(elements[j].first, elements[j].last):
            seen = view.seen[candidate[entry]]
            low, high = 1.0 / FARTHEST_M, 1.0 / NEAREST_M
            own_variance = seen.slope_sigma**2 + view.up_sigma_rad**2
            for end in range(2):
                if not (seen.known[end] and elements[j].known[end]):
                    continue
                rise = elements[j].height_m[end] - z
                height_sigma = prior.value.position_sigma_m[2] * min(
                    abs(seen.slope[end] / rise), 0.2
                )
                slack = AGREEING_SIGMAS * np.sqrt(own_variance + height_sigma * height_sigma)
                first, second = (seen.slope[end] - slack) / rise, (seen.slope[end] + slack) / rise
                hidden = end == 1 and setting.hidden_bottoms > 0.0
                if not hidden:
                    low, high = max(low, min(first, second)), min(high, max(first, second))
                elif rise < 0.0:  # a hidden bottom ends above the mapped one
                    low = max(low, second)
            ranges[entry, 0], ranges[entry, 1] = low, high


@compiled
def _vote_in_block(
    view: UprightView,
    prior: PriorRecord,
    elements: RecordArray,
    candidate: IntArray,
    gate: float,
    x: float,
    y: float,
    z: float,
    table: _VoteTable,
    effort: Effort,
    count: int,
) -> int:
    """Vote at the positions of a block and keep the best headings; return the new ``count``."""
    least_voters, off_m = LEAST_VOTERS, 0.5 * effort.step_m
    for cell in range(BLOCK * BLOCK):
        cell_x = x + (cell % BLOCK - BLOCK // 2) * effort.step_m
        cell_y = y + (cell // BLOCK - BLOCK // 2) * effort.step_m
        dx, dy = cell_x - prior.value.position_m[0], cell_y - prior.value.position_m[1]
        if dx * dx + dy * dy > gate * gate or count + RUNS > len(table.voters):
            continue
        most_voters = _vote(view, elements, candidate, table, cell_x, cell_y, off_m)
        while table.level[least_voters + 1 :].sum() > effort.hypotheses:
            least_voters += 1
        added = _keep_best(prior, cell_x, cell_y, z, most_voters, least_voters, table, count)
        for k in range(count, count + added):
            table.level[table.voters[k]] += 1
        count += added
    return count


@compiled
def _vote(
    view: UprightView,
    elements: RecordArray,
    candidate: IntArray,
    table: _VoteTable,
    x: float,
    y: float,
    off_m: float,
) -> int:
    """Fill the votes at a position, and return the most voters of any heading.

    The true position is up to ``off_m`` away, which widens the votes.
    """
    table.votes[:] = 0
    table.number[:] = 0
    ranges, most_voters = table.ranges, 0
    for j in range(len(elements)):
        mapped = elements[j]
        east, north = mapped.position_m[0] - x, mapped.position_m[1] - y
        square = east * east + north * north
        if not NEAREST_M**2 < square < FARTHEST_M**2:
            continue
        near = 1.0 / np.sqrt(square)
        slack = off_m * near
        low, high = near * (1.0 - slack), near * (1.0 + slack)
        bearing, is_new = 0.0, True
        for entry in range(mapped.first, mapped.last):
            if (
                ranges[entry, 1] < low
                or ranges[entry, 0] > high
                or ranges[entry, 0] > ranges[entry, 1]
            ):
                continue
            i = candidate[entry]
            if i >= MOST_VOTERS:
                break
            if is_new:
                bearing, is_new = _quick_arctan2(north, east), False
            heading = bearing - view.seen[i].azimuth_rad
            most_voters = max(
                most_voters, _vote_around(table, heading, slack + VOTE_SPREAD_RAD, 1 << i)
            )
    return most_voters


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
def _vote_around(table: _VoteTable, heading: float, spread: float, bit: int) -> int:
    """Add an observed element's vote; return the most voters of the headings it voted for."""
    low = int(np.floor((heading - spread) * (BINS / _FULL_TURN)))
    high = int(np.floor((heading + spread) * (BINS / _FULL_TURN)))
    bin, most_voters = low % BINS, 0
    for _ in range(high - low + 1):
        if table.votes[bin] & bit == 0:
            table.votes[bin] |= bit
            table.number[bin] += 1
            most_voters = max(most_voters, table.number[bin])
        bin = bin + 1 if bin + 1 < BINS else 0
    return most_voters


@compiled
def _keep_best(
    prior: PriorRecord,
    x: float,
    y: float,
    z: float,
    most_voters: int,
    least_voters: int,
    table: _VoteTable,
    count: int,
) -> int:
    """Add the headings of a position with the most voters, at least ``least_voters``; return how
    many were added."""
    added = 0
    for voters in range(most_voters, max(most_voters - 2, least_voters - 1), -1):
        start = 0
        while start < BINS and added < RUNS:
            end = start
            while end < BINS and table.number[end] == voters:
                end += 1
            heading = 0.5 * (start + end) * (_FULL_TURN / BINS)
            if end > start and heading_allowed(prior, heading):
                row = table.pose[count + added]
                row[0], row[1], row[2] = x, y, z
                row[3], row[4] = np.cos(heading), np.sin(heading)
                table.voters[count + added] = voters
                added += 1
            start = max(end, start + 1)
    return added


@compiled
def heading_allowed(prior: PriorRecord, heading: float) -> bool:
    """Return whether the prior's heading, if any, allows this one (rad)."""
    if not prior.value.has_heading:
        return True
    off = heading - prior.value.heading_rad
    off = np.arctan2(np.sin(off), np.cos(off))
    return abs(off) <= GATE_SIGMAS * prior.value.heading_sigma_rad + _FULL_TURN / BINS


@compiled
def _most_voted(voters: IntArray, wanted: int) -> IntArray:
    """Return the rows of the ``wanted`` poses with the most voters; ties are drawn evenly."""
    order = np.argsort(-voters, kind="mergesort")
    if len(order) <= wanted:
        return order
    last = voters[order[wanted]]
    above = int((voters > last).sum())
    tied = int((voters == last).sum())
    room = wanted - above
    kept = np.empty(wanted, dtype=np.int64)
    kept[:above] = order[:above]
    for k in range(room):
        kept[above + k] = order[above + k * tied // room]
    return kept

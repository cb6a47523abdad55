"""Upright candidate poses: places round the fix, and the headings that the elements vote for there.

At a place the distance of every mapped element is known, so its height tells which observed
elements it can be; each such match votes for the heading that brings their azimuths together.
Places and headings with the most different voters are the candidates. In contrast to poses made
from pairs of matches, of which false ones are a hundred times as many as true ones, a walk over
places misses no pose that is there, whatever is hidden, cut off or as high as the camera, and takes
a time that is known beforehand.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.effort import Effort
from semviz_core.solving.known import road_heights
from semviz_core.solving.scene import Known, Record, RecordArray, Scene
from semviz_core.solving.standing import standing_elements
from semviz_core.solving.upright import UprightView

BLOCK = 3
"""Places of a square of so many steps share the height of the road and what it implies."""
GATE_SIGMAS, GATE_WIDER_M = 3.0, 1.0
"""How far from the fix places are tried."""
NEAREST_M, FARTHEST_M = 2.5, 60.0
BINS = 180
"""Headings; two degrees each."""
SURE_RAD = float(np.deg2rad(1.0))
"""Votes spread at least so far to either side."""
AGREEING_SIGMAS = 3.3
"""Slopes that differ by more do not vote."""
RUNS = 3
"""Headings kept of a place: those with the most voters, and with one less."""
LEAST_VOTERS = 2
MOST_VOTERS = 60
"""Observed elements that vote; they share the bits of one number."""
_TURN = 2.0 * np.pi


class Hypotheses(NamedTuple):
    """Candidate poses of an upright camera."""

    pose: FloatArray
    """(h, 6) x, y, z, cosine and sine of the heading, and tilt: by how much the camera looks
    further up than the level frame says (rad), here 0. Those with the most voters first."""
    tried: int
    """Places and headings that anything voted for."""


class _Ballot(NamedTuple):
    """What voting needs, and its results so far."""

    ranges: FloatArray  # (p, 2) least and largest 1 / distance at which a match agrees
    votes: IntArray  # (BINS,) for each heading, a bit for each observed element that agrees
    number: IntArray  # (BINS,) how many those are
    pose: FloatArray  # (room, 6) as in Hypotheses
    voters: IntArray  # (room,)
    level: IntArray  # how many poses have so many voters


@compiled
def upright_hypotheses(scene: Scene, view: UprightView, known: Known, effort: Effort) -> Hypotheses:
    """Candidates within the prior's gates."""
    standing, partner = standing_elements(scene)
    gate = GATE_SIGMAS * known.value.place_sigma_m[0] + GATE_WIDER_M
    block_m = BLOCK * effort.step_m
    blocks = int(gate / block_m) + 1
    room = ((2 * blocks + 1) * BLOCK) ** 2 * RUNS
    ballot = _Ballot(
        np.empty((len(partner), 2)),
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
                continue  # a corner that the gate leaves out
            x = known.value.place_m[0] + column * block_m
            y = known.value.place_m[1] + row * block_m
            for z in road_heights(known, x, y):
                _fill_ranges(scene.setting, view, known, standing, partner, z, ballot.ranges)
                count = _try_block(
                    view, known, standing, partner, gate, x, y, z, ballot, effort, count
                )
    return Hypotheses(ballot.pose[_most_voted(ballot.voters[:count], effort.hypotheses)], count)


@compiled
def _fill_ranges(
    setting: Record,
    view: UprightView,
    known: Known,
    standing: RecordArray,
    partner: IntArray,
    z: float,
    ranges: FloatArray,
) -> None:
    """At which 1 / distance the slopes of each match agree, for a camera at height ``z``."""
    for j in range(len(standing)):
        for at in range(standing[j].first, standing[j].last):
            seen = view.seen[partner[at]]
            low, high = 1.0 / FARTHEST_M, 1.0 / NEAREST_M
            own = seen.slope_sigma**2 + view.up_sigma_rad**2
            for end in range(2):
                if not (seen.known[end] and standing[j].known[end]):
                    continue
                rise = standing[j].height_m[end] - z
                height_sigma = known.value.place_sigma_m[2] * min(abs(seen.slope[end] / rise), 0.2)
                slack = AGREEING_SIGMAS * np.sqrt(own + height_sigma * height_sigma)
                one, other = (seen.slope[end] - slack) / rise, (seen.slope[end] + slack) / rise
                hidden = end == 1 and setting.hidden_bottoms > 0.0
                if not hidden:
                    low, high = max(low, min(one, other)), min(high, max(one, other))
                elif rise < 0.0:  # a hidden bottom ends above the mapped one
                    low = max(low, other)
            ranges[at, 0], ranges[at, 1] = low, high


@compiled
def _try_block(
    view: UprightView,
    known: Known,
    standing: RecordArray,
    partner: IntArray,
    gate: float,
    x: float,
    y: float,
    z: float,
    ballot: _Ballot,
    effort: Effort,
    count: int,
) -> int:
    """Let the places of a block vote, and keep the best headings; the new count of poses."""
    least, off_m = LEAST_VOTERS, 0.5 * effort.step_m
    for cell in range(BLOCK * BLOCK):
        place_x = x + (cell % BLOCK - BLOCK // 2) * effort.step_m
        place_y = y + (cell // BLOCK - BLOCK // 2) * effort.step_m
        dx, dy = place_x - known.value.place_m[0], place_y - known.value.place_m[1]
        if dx * dx + dy * dy > gate * gate or count + RUNS > len(ballot.voters):
            continue
        most = _vote(view, standing, partner, ballot, place_x, place_y, off_m)
        while ballot.level[least + 1 :].sum() > effort.hypotheses:
            least += 1
        added = _keep_best(known, place_x, place_y, z, most, least, ballot, count)
        for k in range(count, count + added):
            ballot.level[ballot.voters[k]] += 1
        count += added
    return count


@compiled
def _vote(
    view: UprightView,
    standing: RecordArray,
    partner: IntArray,
    ballot: _Ballot,
    x: float,
    y: float,
    off_m: float,
) -> int:
    """Fill the ballot's votes at a place; the most for any heading. The true place is up to
    ``off_m`` from it, which widens what agrees."""
    ballot.votes[:] = 0
    ballot.number[:] = 0
    ranges, most = ballot.ranges, 0
    for j in range(len(standing)):
        mapped = standing[j]
        east, north = mapped.place_m[0] - x, mapped.place_m[1] - y
        square = east * east + north * north
        if not NEAREST_M**2 < square < FARTHEST_M**2:
            continue
        near = 1.0 / np.sqrt(square)
        slack = off_m * near
        low, high = near * (1.0 - slack), near * (1.0 + slack)
        bearing, is_new = 0.0, True
        for at in range(mapped.first, mapped.last):
            if ranges[at, 1] < low or ranges[at, 0] > high or ranges[at, 0] > ranges[at, 1]:
                continue
            i = partner[at]
            if i >= MOST_VOTERS:
                break
            if is_new:
                bearing, is_new = _quick_arctan2(north, east), False
            heading = bearing - view.seen[i].azimuth_rad
            most = max(most, _vote_around(ballot, heading, slack + SURE_RAD, 1 << i))
    return most


@compiled
def _quick_arctan2(y: float, x: float) -> float:
    """Within 2e-4 rad, in a quarter of the time (Abramowitz and Stegun 1964, 4.4.49)."""
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
def _vote_around(ballot: _Ballot, heading: float, spread: float, bit: int) -> int:
    """Let one observed element vote; the most that any of these headings have now."""
    low = int(np.floor((heading - spread) * (BINS / _TURN)))
    high = int(np.floor((heading + spread) * (BINS / _TURN)))
    at, most = low % BINS, 0
    for _ in range(high - low + 1):
        if ballot.votes[at] & bit == 0:
            ballot.votes[at] |= bit
            ballot.number[at] += 1
            most = max(most, ballot.number[at])
        at = at + 1 if at + 1 < BINS else 0
    return most


@compiled
def _keep_best(
    known: Known,
    x: float,
    y: float,
    z: float,
    most: int,
    least: int,
    ballot: _Ballot,
    count: int,
) -> int:
    """Add the headings of a place with the most voters, ``least`` or more; how many."""
    added = 0
    for wanted in range(most, max(most - 2, least - 1), -1):
        at = 0
        while at < BINS and added < RUNS:
            end = at
            while end < BINS and ballot.number[end] == wanted:
                end += 1
            heading = 0.5 * (at + end) * (_TURN / BINS)
            if end > at and _heading_allowed(known, heading):
                row = ballot.pose[count + added]
                row[0], row[1], row[2] = x, y, z
                row[3], row[4] = np.cos(heading), np.sin(heading)
                ballot.voters[count + added] = wanted
                added += 1
            at = max(end, at + 1)
    return added


@compiled
def _heading_allowed(known: Known, heading: float) -> bool:
    if not known.value.has_heading:
        return True
    off = heading - known.value.heading_rad
    off = np.arctan2(np.sin(off), np.cos(off))
    return abs(off) <= GATE_SIGMAS * known.value.heading_sigma_rad + _TURN / BINS


@compiled
def _most_voted(voters: IntArray, wanted: int) -> IntArray:
    """Rows of the ``wanted`` with the most voters; of the last that fit, evenly drawn ones."""
    order = np.argsort(-voters, kind="mergesort")
    if len(order) <= wanted:
        return order
    last = voters[order[wanted]]
    sure = int((voters > last).sum())
    equal = int((voters == last).sum())
    room = wanted - sure
    kept = np.empty(wanted, dtype=np.int64)
    kept[:sure] = order[:sure]
    for k in range(room):
        kept[sure + k] = order[sure + k * equal // room]
    return kept

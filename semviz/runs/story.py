"""Tell the story of a run: how many frames are right, what explains the others, and where they are.

A frame is right if its pose is within 1 m of the true one or, without ground truth, if its status
is ok. Causes that the whole run shows come first; the other wrong frames are grouped by their own
diagnosis. No frame counts twice.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.frame_table import STATUSES, frame_table
from semviz.runs.metrics import OVERCONFIDENT_M
from semviz.runs.run import Run
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.diagnosis.fault import RunFault
from semviz_core.diagnosis.run import RunDiagnosis

PART_M = 25.0
"""Length of a part of the route; shorter where the drive is."""
PARTS = 60
"""A short drive has about so many parts."""
SHORTEST_PART_M = 1.0


@dataclass(frozen=True)
class Cause:
    """What explains some of the wrong frames."""

    kind: str
    """A kind of fault, also kinds that the run cannot tell apart, or a name of a diagnosis."""
    sentence: str
    frames: tuple[int, ...]
    """Positions of the wrong frames that it explains, in order."""
    is_of_run: bool
    """Whether the run as a whole shows it, not only its single frames."""


@dataclass(frozen=True, eq=False)
class RoutePart:
    """A part of the route, with the frames of all passes over it."""

    points_m: FloatArray
    """(k, 2) x and y in the map frame, along the first pass."""
    frames: tuple[int, ...]
    """Positions in the run."""
    wrong: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class RunStory:
    """What a run tells as a whole."""

    run: Run
    is_wrong: BoolArray
    """(n,) of each frame."""
    causes: tuple[Cause, ...]
    """By falling number of wrong frames."""
    harmless: tuple[RunFault, ...]
    """What the whole run shows that makes no frame wrong by itself, in most frames first."""
    route: tuple[RoutePart, ...]
    length_m: float

    @cached_property
    def right(self) -> int:
        """Number of frames that are right."""
        return int((~self.is_wrong).sum())

    def parts_of(self, cause: Cause) -> tuple[int, ...]:
        """Return rows of ``route`` with frames of a cause, the part with most of them first."""
        frames = set(cause.frames)
        shared = [len(frames.intersection(part.wrong)) for part in self.route]
        return tuple(row for row in np.argsort(shared)[::-1].tolist() if shared[row])

    @property
    def headline(self) -> str:
        """One or two short sentences: how many frames are right, and what explains the rest."""
        frames = len(self.is_wrong)
        right = "within 1 m" if _has_truth(self.run) else "ok"
        first = f"{self.right:,} of {frames:,} frames are {right}."
        wrong = frames - self.right
        if not self.causes or not wrong:
            return first
        kind = self.causes[0].kind.capitalize()
        if len(self.causes) == 1:
            return f"{first} {kind} explains the {_other(wrong)}."
        more = len(self.causes) - 1
        others = "another cause" if more == 1 else f"{more} more causes"
        return f"{first} {kind} and {others} explain the {_other(wrong)}."

    @property
    def detail(self) -> str:
        """The largest causes, with the frames that they explain, then what does no harm."""
        told = [
            f"{cause.kind.capitalize()}: {frames_text(self.run, cause.frames)}."
            for cause in self.causes[:2]
        ]
        if kinds := Counter(kinds_text(fault) for fault in self.harmless):
            named = (f"{number} {kind}" if number > 1 else kind for kind, number in kinds.items())
            told.append(f"Also found, without a wrong frame of its own: {', '.join(named)}.")
        return " ".join(told)


def kinds_text(fault: RunFault) -> str:
    """Return the kind of a fault with those that the run cannot tell from it."""
    return " or ".join((fault.kind, *fault.rivals))


def tell(run: Run, diagnosis: RunDiagnosis | None) -> RunStory:
    """Return the story of a run; without its diagnosis, from those of its frames."""
    is_wrong = wrong_frames(run)
    causes = _causes(run, diagnosis, is_wrong)
    named = {cause.sentence for cause in causes}
    harmless = [fault for fault in _faults(diagnosis) if fault.sentence not in named]
    harmless.sort(key=lambda fault: -len(fault.frames))
    centers = _centers(run)
    length_m = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()) if len(centers) else 0
    route = _route(centers, is_wrong)
    return RunStory(run, is_wrong, causes, tuple(harmless), route, length_m)


def _faults(diagnosis: RunDiagnosis | None) -> list[RunFault]:
    if diagnosis is None:
        return []
    camera = [] if diagnosis.calibration is None else [diagnosis.calibration]
    return [*diagnosis.causes, *camera, *diagnosis.elements]


def stretches(frames: Sequence[int]) -> list[tuple[int, int]]:
    """Return first and last of each group of consecutive positions."""
    groups: list[tuple[int, int]] = []
    for position in frames:
        if groups and groups[-1][1] + 1 == position:
            groups[-1] = (groups[-1][0], position)
        else:
            groups.append((position, position))
    return groups


LISTED = 3
"""Stretches that are named, the longest ones."""


def frames_text(run: Run, frames: Sequence[int]) -> str:
    """Return the numbers of frames as text, "frames 29-47, 52 and 3 more stretches"."""
    groups = stretches(frames)
    longest = sorted(groups, key=lambda group: group[0] - group[1])[:LISTED]
    number = frame_table(run).index
    named = [
        str(number[first]) if first == last else f"{number[first]}-{number[last]}"
        for first, last in sorted(longest)
    ]
    word = "frame" if len(frames) == 1 else "frames"
    more = len(groups) - len(longest)
    rest = f" and {more} more {'stretch' if more == 1 else 'stretches'}" if more else ""
    return f"{word} {', '.join(named)}{rest}"


def _other(wrong: int) -> str:
    return "other one" if wrong == 1 else f"other {wrong:,}"


def _has_truth(run: Run) -> bool:
    return bool(frame_table(run).has_truth.any())


def wrong_frames(run: Run) -> BoolArray:
    """Return (n,) whether each frame is wrong: over 1 m off or without a pose; without a true pose,
    whether its status is not ok."""
    table = frame_table(run)
    known = np.isfinite(table.distance_m)
    without_error = table.has_truth | ~table.is_ok
    return np.where(known, table.distance_m > OVERCONFIDENT_M, without_error)


def worst_position(run: Run) -> int:
    """Return the position of the worst frame: a sure and wrong pose, another wrong one, the larger
    error first, then no pose; without such a frame the first."""
    table, wrong = frame_table(run), np.flatnonzero(wrong_frames(run))
    if not len(wrong):
        return 0
    error_m = np.nan_to_num(table.distance_m[wrong])
    is_sure = table.is_ok[wrong] & np.isfinite(table.distance_m[wrong])
    return int(wrong[np.lexsort((-wrong, error_m, is_sure))[-1]])


def _causes(run: Run, diagnosis: RunDiagnosis | None, is_wrong: BoolArray) -> tuple[Cause, ...]:
    """Give every wrong frame to one cause: that of the run which explains most, or its own."""
    wrong, table = np.flatnonzero(is_wrong), frame_table(run)
    names = dict(zip(wrong.tolist(), table.texts_of(table.diagnosis[wrong]), strict=True))
    causes: list[Cause] = []
    explained: list[tuple[RunFault, list[int]]] = []
    if diagnosis is not None:
        explained += [(fault, _explained(fault, names)) for fault in diagnosis.causes]
        explained += [(fault, _with_its_name(fault, names)) for fault in diagnosis.elements]
    if diagnosis is not None and diagnosis.calibration is not None:
        fault = diagnosis.calibration
        if names:
            causes.append(Cause(kinds_text(fault), fault.sentence, tuple(names), is_of_run=True))
        names = {}
    for fault, frames in sorted(explained, key=lambda pair: -len(pair[1])):
        left = tuple(position for position in frames if position in names)
        if left:
            causes.append(Cause(kinds_text(fault), fault.sentence, left, is_of_run=True))
            for position in left:
                del names[position]
    causes.extend(_by_name(run, names))
    return tuple(sorted(causes, key=lambda cause: -len(cause.frames)))


def _explained(fault: RunFault, wrong: dict[int, str]) -> list[int]:
    """Return the wrong frames that are healthy once a prior, a sigma or the map is corrected."""
    return [position for position in fault.frames if position in wrong]


def _with_its_name(fault: RunFault, wrong: dict[int, str]) -> list[int]:
    """Return the wrong frames with the fault of an element, if it is what their diagnosis names."""
    return [position for position in fault.frames if wrong.get(position) == fault.kind]


def _by_name(run: Run, names: dict[int, str]) -> list[Cause]:
    """Group frames by diagnosis; the sentence is that of the middle frame."""
    groups: dict[str, list[int]] = defaultdict(list)
    for position, name in names.items():
        groups[name].append(position)
    causes = []
    for name, frames in groups.items():
        example = run.frames[frames[len(frames) // 2]]
        sentence = frame_diagnosis(run, example).sentence or example.localization.reason
        causes.append(Cause(name, sentence, tuple(frames), is_of_run=False))
    return causes


def _centers(run: Run) -> FloatArray:
    """Return (n, 2) centres: the true one, that of an ok pose, the prior, or between neighbours."""
    table = frame_table(run)
    sure_m = np.where(table.is_ok[:, None], table.estimate_m, np.nan)
    centers = table.prior_m[:, :2].copy()
    for better_m in (sure_m[:, :2], table.truth_m[:, :2]):
        centers = np.where(np.isfinite(better_m), better_m, centers)
    known = np.flatnonzero(np.isfinite(centers).all(axis=1))
    if not len(known):
        return np.zeros((0, 2))
    rows = np.arange(len(centers))
    return np.stack([np.interp(rows, known, centers[known, axis]) for axis in (0, 1)], axis=1)


def _route(centers: FloatArray, is_wrong: BoolArray) -> tuple[RoutePart, ...]:
    """Cut the drive into parts of equal length; later passes over a part join it."""
    if not len(centers):
        return ()
    along_m = np.concatenate([[0.0], np.linalg.norm(np.diff(centers, axis=0), axis=1).cumsum()])
    part_m = float(np.clip(along_m[-1] / PARTS, SHORTEST_PART_M, PART_M))
    piece = (along_m / part_m).astype(np.int64)
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    merged = _merged_passes(centers, starts, part_m)
    members: dict[int, list[IntArray]] = defaultdict(list)
    for number, rows in enumerate(np.split(np.arange(len(centers)), starts[1:])):
        members[merged[number]].append(rows)
    parts = []
    for passes in members.values():
        rows, first = np.concatenate(passes), passes[0]
        line = centers[first[0] : first[-1] + 2]  # up to the start of the next part
        wrong = tuple(rows[is_wrong[rows]].tolist())
        parts.append(RoutePart(line, tuple(rows.tolist()), wrong))
    return tuple(parts)


def _merged_passes(centers: FloatArray, starts: IntArray, part_m: float) -> list[int]:
    """Return, of each piece of the drive, the first piece that starts at its place."""
    first_at: dict[tuple[int, int], int] = {}
    merged = []
    for number, start in enumerate(starts):
        x, y = np.floor(centers[start] / part_m).astype(int).tolist()
        around = [first_at.get((x + i, y + j)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        near = [
            other
            for other in around
            if other is not None
            and number - other > 2  # neighbours of one pass stay apart
            and np.linalg.norm(centers[starts[other]] - centers[start]) < 0.7 * part_m
        ]
        merged.append(min(near, default=number))
        first_at.setdefault((x, y), merged[-1])
    return merged


MOST_DIAGNOSED = 1_000
"""Frames that the diagnosis of a run rests on, which are held in memory."""
STRETCH = 50
"""Consecutive frames, so that several see the same elements."""


def typical_positions(run: Run, most: int = MOST_DIAGNOSED) -> list[int]:
    """Return the positions of at most so many frames, in order, that stand for a long run.

    They are whole stretches: half of them where most frames are wrong, the others evenly spread.
    """
    frames = len(run.frames)
    if frames <= most:
        return list(range(frames))
    starts, chosen = np.arange(0, frames, STRETCH), most // STRETCH
    wrong = np.add.reduceat(wrong_frames(run).astype(np.int64), starts)
    worst = np.argsort(-wrong, kind="stable")[: chosen // 2]
    others = np.setdiff1d(np.arange(len(starts)), worst)
    spread = others[np.linspace(0, len(others) - 1, chosen - len(worst)).astype(np.int64)]
    rows = np.sort(starts[np.concatenate([worst, spread])])
    return [int(k) for start in rows for k in range(start, min(start + STRETCH, frames))]


def counts_by_status(run: Run) -> Counter[str]:
    """Return the number of frames of each status."""
    rows = np.bincount(frame_table(run).status, minlength=len(STATUSES))
    return Counter(dict(zip(STATUSES, rows.tolist(), strict=True)))

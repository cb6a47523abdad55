"""How a frame's answer came about: stages, poses tried, pairs, and the way to the optimum."""

from typing import Any

import numpy as np

from semviz import follow
from semviz.inspector.scene.hypothesis import Hypothesis
from semviz.inspector.topic import Topic, Verbs, whole
from semviz.inspector.views import number
from semviz.pose_errors import difference
from semviz.recording.run import FrameRecord, Run
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError
from semviz_core.localization import Localization, Refinement, Search
from semviz_core.pose import Pose

Json = dict[str, Any]


class SolverTopic(Topic):
    """Tells the page what the frame's answer came from, and shows one of its poses in 3D."""

    _shown: int | None = None
    """Row of the pose that is shown."""
    _is_drawn: bool = False
    """Whether one is in 3D, of this frame or of the one before."""

    def verbs(self) -> Verbs:
        return {"solver": self._tell, "hypothesis": self._show}

    def on_frame(self) -> None:
        self._shown = None

    def on_drawn(self) -> None:
        if self._is_drawn:  # else the 3D pane need not be asked with every frame
            self._draw()

    def _tell(self, _: Message) -> None:
        desk = self.desk
        desk.say("solver", {**solver_view(desk.run, desk.state.position), "shown": self._shown})

    def _show(self, message: Message) -> None:
        """The pose ``row``, or none where it is left out."""
        row = whole(message, "row")
        poses = 0 if self._search is None else len(self._search.score)
        if row is not None and not 0 <= row < poses:
            raise SemvizError(f"pose {row} does not exist; the search found {poses} here")
        self._shown = row
        self._draw()
        self._tell(message)

    def _draw(self) -> None:
        desk, search, row = self.desk, self._search, self._shown
        shown = None
        if search is not None and row is not None:
            camera = self._localization.camera
            shown = Hypothesis(letter(row), search.T_camera_map[row].inverse(), camera)
        desk.scene.show_hypothesis(shown, desk.state)
        self._is_drawn = shown is not None

    @property
    def _localization(self) -> Localization:
        return self.desk.run.frames[self.desk.state.position].localization

    @property
    def _search(self) -> Search | None:
        return self._localization.search


def letter(row: int) -> str:
    """Of the poses of the search, the best is A; alternatives in 3D have the same from B on."""
    return "ABCDEFGH"[row : row + 1] or str(row + 1)


def solver_view(run: Run, position: int) -> Json:
    """Everything of one frame; stages that it lacks are null, with a line that says why."""
    record = run.frames[position]
    one = record.localization
    return {
        "position": position,
        "stages": [[stage, ms] for stage, ms in one.time_ms.items()],
        "search": None if one.search is None else _search(record, one.search),
        "pairs": None if one.refinement is None else _pairs(run, record, one.refinement),
        "trace": _trace(one),
        "notes": notes(one),
    }


def notes(one: Localization) -> list[str]:
    """What the method has not, or the run does not hold: one line each."""
    fine, found = one.refinement, one.search
    said = []
    if found is None:
        said.append(_no_search(one))
    elif one.method == "direct":
        said.append("Direct: classes alone fixed the pairs; the search only says where to begin.")
    if fine is not None and len(fine.cost_trace) < 2:
        said.append(
            "Nothing was iterated: odometry and earlier frames carry the pose."
            if one.method == follow.METHOD
            else "The way to the optimum was not recorded."
        )
    is_old = found is not None and found.mapped is None
    if is_old or (fine is not None and len(fine.cost_trace) > 1 and fine.steps is None):
        said.append("Recorded by an older semviz, which kept fewer steps; localize again for all.")
    return said


def _no_search(one: Localization) -> str:
    if one.T_camera_map is None:
        return "Nothing was searched: see the reason under Why."
    if one.method == follow.METHOD:
        return "Nothing was searched: the pose was known from the frame before."
    return "This method records no search: its matches were given."


def _search(record: FrameRecord, found: Search) -> Json:
    score = found.score
    likely = np.exp(score - score.max()) if len(score) else score
    return {
        "tried": found.hypotheses,
        "passed": found.passed,
        "poses": [
            _hypothesis(record, found, row, float(likely[row] / likely.sum()))
            for row in range(len(score))
        ],
    }


def _hypothesis(record: FrameRecord, found: Search, row: int, share: float) -> Json:
    """One pose of the search, beside the answer and the truth."""
    pose, answer = found.T_camera_map[row], record.localization.T_camera_map
    pairs = None if found.mapped is None else int((found.mapped[row] >= 0).sum())
    return {
        "letter": letter(row),
        "score": number(found.score[row]),
        "behind": number(found.score[0] - found.score[row]),
        "share": share,
        "pairs": pairs,
        "fromAnswer": _apart(pose, None if answer is None else answer.inverse()),
        "fromTruth": _apart(pose, record.frame.T_map_camera),
    }


def _apart(T_camera_map: Pose, other: Pose | None) -> Json | None:
    """To another pose T_map_camera."""
    if other is None:
        return None
    apart = difference(T_camera_map.inverse(), other)
    return {"m": apart.distance_m, "deg": apart.angle_deg}


def _pairs(run: Run, record: FrameRecord, fine: Refinement) -> list[Json]:
    """What the answer rests on first, then what it turned down; each by its element."""
    size_px = np.sqrt(np.nansum(fine.residual_px**2, axis=1))
    ids = record.localization.submap.id[fine.pairs[:, 1]]
    rows = sorted(range(len(ids)), key=lambda row: (not fine.inlier[row], -size_px[row]))
    return [
        {
            "observed": int(fine.pairs[row, 0]),
            "element": int(ids[row]),
            "name": run.semantic_map.name_of(int(ids[row])),
            "class": int(record.localization.submap.class_id[fine.pairs[row, 1]]),
            "inlier": bool(fine.inlier[row]),
            "true": _is_true(record, fine, row),
            "residualPx": number(size_px[row]),
            "chi2": number(fine.chi2[row]),
            "supportNats": None if fine.support is None else number(fine.support[row]),
            "openM": None if fine.open_m is None else number(fine.open_m[row]),
        }
        for row in rows
    ]


def _is_true(record: FrameRecord, fine: Refinement, row: int) -> bool | None:
    """None where no ids are known."""
    if record.frame.T_map_camera is None or not (record.element_id >= 0).any():
        return None
    observed, mapped = fine.pairs[row]
    return bool(record.element_id[observed] == record.localization.submap.id[mapped])


def _trace(one: Localization) -> Json | None:
    """Cost and steps of refinement, and how far it went from the best pose of the search."""
    fine = one.refinement
    if fine is None or len(fine.cost_trace) < 2:
        return None
    steps = np.zeros((0, 2)) if fine.steps is None else fine.steps
    begun = one.search.T_camera_map[0] if one.search and one.search.T_camera_map else None
    answer = one.T_camera_map
    moved = None if begun is None or answer is None else _apart(begun, answer.inverse())
    return {
        "cost": [number(cost) for cost in fine.cost_trace],
        "steps": [{"m": float(m), "deg": float(np.rad2deg(rad))} for m, rad in steps],
        "moved": moved,
    }

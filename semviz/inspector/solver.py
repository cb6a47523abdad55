"""Show how a frame was solved: stages, candidate poses, pairs, and iterations.

The best candidate pose is A, the alternatives are B onwards. A missing stage is null, with a
note that gives the reason.
"""

import numpy as np

from semviz.inspector import views_frame
from semviz.inspector.context import Panel
from semviz.inspector.messages import GetSolverRequest, ShowSearchPoseRequest
from semviz.inspector.scene.scene_cameras import SearchPose
from semviz.inspector.views import number
from semviz.runs.metrics import difference
from semviz.runs.run import TRACK, FrameRecord, Run
from semviz.web.protocol import RefusedError, handles
from semviz_core.base.localization import Localization, Refinement, Search
from semviz_core.base.pose import Pose


class SolverPanel(Panel):
    """Sends how the frame was solved, and shows a candidate pose in 3D."""

    _shown: int | None = None
    """Row of the shown pose."""
    _is_drawn: bool = False
    """Whether a pose is in 3D, of this frame or the frame before."""

    def on_frame(self) -> None:
        self._shown = None

    def on_drawn(self) -> None:
        if self._is_drawn:  # else the 3D pane needs no update
            self._draw()

    @handles(GetSolverRequest)
    def _get(self, _: GetSolverRequest) -> None:
        self._send()

    @handles(ShowSearchPoseRequest)
    def _show(self, request: ShowSearchPoseRequest) -> None:
        row = request.row
        poses = 0 if self._search is None else len(self._search.score)
        if row is not None and not 0 <= row < poses:
            text = f"pose {row} does not exist; the search found {poses}"
            raise RefusedError("not_found", text)
        self._shown = row
        self._draw()
        self._send()

    def _send(self) -> None:
        context = self.context
        context.send(solver_view(context.run, context.state.position, self._shown))

    def _draw(self) -> None:
        context, search, row = self.context, self._search, self._shown
        shown = None
        if search is not None and row is not None:
            camera = self._localization.camera
            shown = SearchPose(letter(row), search.T_camera_map[row].inverse(), camera)
        context.scene.show_search_pose(shown, context.state)
        self._is_drawn = shown is not None

    @property
    def _localization(self) -> Localization:
        return self.context.run.frames[self.context.state.position].localization

    @property
    def _search(self) -> Search | None:
        return self._localization.search


def letter(row: int) -> str:
    """Return the letter of a pose of the search: A for the best, as for alternatives in 3D."""
    return "ABCDEFGH"[row : row + 1] or str(row + 1)


def solver_view(run: Run, position: int, shown: int | None = None) -> views_frame.SolverEvent:
    """Return how one frame was solved. ``shown`` is the row of the pose shown in 3D."""
    record = run.frames[position]
    localization = record.localization
    return views_frame.SolverEvent(
        position=position,
        stages=tuple(localization.time_ms.items()),
        search=None if localization.search is None else _search(record, localization.search),
        pairs=(
            None
            if localization.refinement is None
            else _pairs(run, record, localization.refinement)
        ),
        trace=_trace(localization),
        notes=tuple(missing_stages(localization)),
        shown=shown,
    )


def missing_stages(localization: Localization) -> list[str]:
    """Return a line for each stage that the method lacks, or that was not recorded."""
    refinement, search = localization.refinement, localization.search
    notes = []
    if search is None:
        notes.append(_no_search(localization))
    elif localization.method == "direct":
        notes.append(
            "Direct: classes alone determine the pairs; the search only provides the start."
        )
    if refinement is not None and len(refinement.cost_trace) < 2:
        notes.append(
            "No iterations: the pose follows from odometry and earlier frames."
            if localization.method == TRACK
            else "The iterations were not recorded."
        )
    lacks_steps = (
        refinement is not None and len(refinement.cost_trace) > 1 and refinement.steps is None
    )
    if lacks_steps or (search is not None and search.mapped is None):
        notes.append("Recorded by an older semviz with fewer steps; localize again to see all.")
    return notes


def _no_search(localization: Localization) -> str:
    if localization.T_camera_map is None:
        return "No search: see the reason under Why."
    if localization.method == TRACK:
        return "No search: the pose was predicted from the previous frame."
    return "No search: this method starts from given matches."


def _search(record: FrameRecord, search: Search) -> views_frame.SearchView:
    score = search.score
    weight = np.exp(score - score.max()) if len(score) else score
    poses = tuple(
        _search_pose(record, search, row, float(weight[row] / weight.sum()))
        for row in range(len(score))
    )
    return views_frame.SearchView(tried=search.hypotheses, passed=search.passed, poses=poses)


def _search_pose(
    record: FrameRecord, search: Search, row: int, share: float
) -> views_frame.SearchPoseView:
    """Return one pose of the search, with its distances from the estimate and the true pose."""
    pose, estimate = search.T_camera_map[row], record.localization.T_camera_map
    pairs = None if search.mapped is None else int((search.mapped[row] >= 0).sum())
    return views_frame.SearchPoseView(
        letter=letter(row),
        score=number(search.score[row]),
        behind=number(search.score[0] - search.score[row]),
        share=share,
        pairs=pairs,
        from_answer=_difference(pose, None if estimate is None else estimate.inverse()),
        from_truth=_difference(pose, record.frame.T_map_camera),
    )


def _difference(T_camera_map: Pose, T_map_camera: Pose | None) -> views_frame.PoseDifference | None:
    if T_map_camera is None:
        return None
    errors = difference(T_camera_map.inverse(), T_map_camera)
    return views_frame.PoseDifference(m=errors.distance_m, deg=errors.angle_deg)


def _pairs(
    run: Run, record: FrameRecord, refinement: Refinement
) -> tuple[views_frame.SolvedPair, ...]:
    """Return the pairs: inliers, then outliers, each by decreasing residual."""
    size_px = np.sqrt(np.nansum(refinement.residual_px**2, axis=1))
    ids = record.localization.submap.id[refinement.pairs[:, 1]]
    rows = sorted(range(len(ids)), key=lambda row: (not refinement.inlier[row], -size_px[row]))
    return tuple(
        views_frame.SolvedPair(
            observed=int(refinement.pairs[row, 0]),
            element=int(ids[row]),
            name=run.semantic_map.name_of(int(ids[row])),
            class_id=int(record.localization.submap.class_id[refinement.pairs[row, 1]]),
            inlier=bool(refinement.inlier[row]),
            is_true=_is_true(record, refinement, row),
            residual_px=number(size_px[row]),
            chi2=number(refinement.chi2[row]),
            support_nats=None if refinement.support is None else number(refinement.support[row]),
            open_m=None if refinement.open_m is None else number(refinement.open_m[row]),
        )
        for row in rows
    )


def _is_true(record: FrameRecord, refinement: Refinement, row: int) -> bool | None:
    """Whether a pair is true; None if the true elements are unknown."""
    if record.frame.T_map_camera is None or not (record.element_id >= 0).any():
        return None
    observed, mapped = refinement.pairs[row]
    return bool(record.element_id[observed] == record.localization.submap.id[mapped])


def _trace(localization: Localization) -> views_frame.TraceView | None:
    """Return cost and step of each iteration, and the distance from the best pose of the search."""
    refinement, search = localization.refinement, localization.search
    if refinement is None or len(refinement.cost_trace) < 2:
        return None
    steps = np.zeros((0, 2)) if refinement.steps is None else refinement.steps
    start = search.T_camera_map[0] if search and search.T_camera_map else None
    end = localization.T_camera_map
    moved = None if start is None or end is None else _difference(start, end.inverse())
    return views_frame.TraceView(
        cost=tuple(number(cost) for cost in refinement.cost_trace),
        steps=tuple(
            views_frame.PoseDifference(m=float(m), deg=float(np.rad2deg(rad))) for m, rad in steps
        ),
        moved=moved,
    )

"""What is selected: its candidates and residuals in the frame, and what is known of the element."""

import threading
from typing import Any

import numpy as np

from semviz.inspector.mending.labels import Mending
from semviz.inspector.selection.element_card import element_card, mapped, origins_view
from semviz.inspector.selection.matrix import candidates_of_column, candidates_of_row
from semviz.inspector.selection.origins import Origins, map_row
from semviz.inspector.session import Selection, State
from semviz.inspector.topic import Topic, Verbs
from semviz.recording.run import FrameRecord, Run
from semviz.verdicts import detector_of, truth_of
from semviz.web.sessions import Message
from semviz_core.explaining.told import FALSE, UNKNOWN
from semviz_core.pose import Pose
from semviz_core.solving.residuals import INLIER_CHI2, scene_residuals
from semviz_core.solving.scene import Scene

Json = dict[str, Any]


class SelectedTopic(Topic):
    """Tells the page all about the selection, with the frame or state in which it is another; and,
    when asked, what the label file says of it."""

    _told: Selection | None = None

    def verbs(self) -> Verbs:
        return {"origins": self._origins}

    def on_frame(self) -> None:
        self._tell()

    def on_state(self) -> None:
        if self.desk.state.selection != self._told:
            self._tell()

    def _tell(self) -> None:
        self._told = self.desk.state.selection
        self.desk.say("selected", selected_view(self.desk.run, self.desk.state))

    def _origins(self, _: Message) -> None:
        element = self.desk.state.selection.element
        if element is not None:
            ask = (self.desk.run, self.desk.kept(Mending).origins, element)
            work = threading.Thread(
                target=self._tell_origins, args=ask, name="origins", daemon=True
            )
            work.start()

    def _tell_origins(self, run: Run, origins: Origins, element: int) -> None:
        """In a thread of its own: a large label file takes a second to read."""
        view = origins_view(run, origins, element)
        desk = self.desk
        with desk.lock:
            if desk.run is run and desk.state.selection.element == element:
                desk.say("origins", view)


def selected_view(run: Run, state: State) -> Json | None:
    """All that a run knows of the selection; None where nothing is selected."""
    observed, element = state.selection.observed, state.selection.element
    record = run.frames[state.position]
    if state.selection == Selection():
        return None
    shown: Json = {"observed": observed, "element": element}
    if observed is not None:
        shown["name"] = f"#{observed}"
        shown["class"] = int(record.localization.observed.class_id[observed])
        shown["ofRow"] = candidates_of_row(run, record, observed)
    if element is not None:
        shown |= element_card(run, record, element)  # its name goes before the detection's
        shown["ofColumn"] = candidates_of_column(record, element)
    shown["said"] = [_role(run, record, state.selection), _truly(run, record, state.selection)]
    shown["residuals"] = _residuals(run, record, state.selection)
    return shown


def _role(run: Run, record: FrameRecord, selection: Selection) -> str:
    """What the answer made of the selection."""
    observed, element = selection.observed, selection.element
    one = record.localization
    if element is not None and element not in one.submap.id:
        away_m = np.linalg.norm((mapped(run, element).anchor_m[0] - one.prior.position_m)[:2])
        return f"Outside of this frame's submap, {away_m:.0f} m from the prior."
    if one.refinement is None:
        return "This frame has no pairs."
    i, j = one.refinement.pairs.T
    of_observed = np.ones(len(i), bool) if observed is None else i == observed
    of_element = np.ones(len(j), bool) if element is None else one.submap.id[j] == element
    found = np.flatnonzero(of_observed & of_element)
    if not len(found):
        alone = observed is None or element is None
        return "Without a pair in the answer." if alone else "Not a pair of the answer."
    fits = one.refinement.inlier[found[0]]
    return (
        "A pair of the answer, and it fits." if fits else "A pair of the answer that does not fit."
    )


def _truly(run: Run, record: FrameRecord, selection: Selection) -> str:
    """What the detection truly is, or which detection the element truly has; empty if unknown."""
    observed, element = selection.observed, selection.element
    truth = truth_of(run, record)
    if truth is None or truth.element_id is None:
        return ""
    if observed is None:
        seen = np.flatnonzero(truth.element_id == element).tolist()
        return f"Truly it is #{seen[0]}." if seen else "Truly no detection is of it."
    true = int(truth.element_id[observed])
    if true == element:
        return "It is the true pair."
    if true == UNKNOWN:
        return f"What #{observed} truly is, is not known."
    if true == FALSE or map_row(run.semantic_map, true) is None:
        what = "nothing real: a false detection" if true == FALSE else "not in the map"
        return f"Truly, #{observed} is {what}."
    outside = "" if true in record.localization.submap.id else ", outside of the submap"
    return f"Truly, #{observed} is {run.semantic_map.name_of(true)}{outside}."


def _residuals(run: Run, record: FrameRecord, selection: Selection) -> list[Json]:
    """Of the selected pair, or of the true one with what is selected, at estimate and truth."""
    pair = _pair(run, record, selection)
    if pair is None:
        return []
    answer, truth = record.localization.T_camera_map, record.frame.T_map_camera
    named = {"pair": f"#{pair[0]} × {run.semantic_map.name_of(pair[1])}"}
    at_truth = None if truth is None else truth.inverse()
    return [
        {**named, "at": "estimate", **_residual(run, record, pair, answer, "no pose")},
        {**named, "at": "truth", **_residual(run, record, pair, at_truth, "not known")},
    ]


def _pair(run: Run, record: FrameRecord, selection: Selection) -> tuple[int, int] | None:
    """Observed row and element's id."""
    observed, element = selection.observed, selection.element
    if element is None and observed is not None:
        element = int(record.element_id[observed])
    elif observed is None:
        observed = next(iter(np.flatnonzero(record.element_id == element).tolist()), None)
    if observed is None or element is None or map_row(run.semantic_map, element) is None:
        return None
    return observed, element


def _residual(
    run: Run, record: FrameRecord, pair: tuple[int, int], T_camera_map: Pose | None, without: str
) -> Json:
    """Pixels across and along (u and v of signs), chi2 and its limit; or why there are none."""
    if T_camera_map is None:
        return {"reason": without}
    one, element = record.localization, mapped(run, pair[1])
    scene = Scene.of(one.camera, one.observed[[pair[0]]], element, detector_of(run))
    if not scene.compatible[0, 0]:
        return {"reason": "classes differ"}
    fit = scene_residuals(scene, T_camera_map, np.zeros((1, 2), dtype=np.int64))
    if not np.isfinite(fit.chi2[0]):
        return {"reason": "not in front of the camera"}
    across, along = fit.residual_px[0].tolist()
    return {
        "px": float(np.sqrt(np.nansum(fit.residual_px[0] ** 2))),
        "acrossPx": across,
        "alongPx": along if np.isfinite(along) else None,
        "chi2": float(fit.chi2[0]),
        "limit": float(INLIER_CHI2[fit.rows[0]]),
        "fits": bool(fit.inlier[0]),
    }

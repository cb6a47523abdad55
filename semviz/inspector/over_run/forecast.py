"""What the map lets a camera know along a run's route, worked out when first asked for."""

from pathlib import Path
from typing import Any

import numpy as np

from semviz.inspector.background import Background
from semviz.inspector.topic import Topic, Verbs
from semviz.localizability import conditions_of, options_of, positions, with_measured_recall
from semviz.localizability_report import change, new_element
from semviz.recording.run import Run
from semviz.web.sessions import Message
from semviz_core.localizability.conditions import Conditions
from semviz_core.localizability.effects import Effect
from semviz_core.localizability.predict import LIMITS_M, Localizability, predict
from semviz_core.pose import Pose

NEAR_M = 3.0
"""A frame takes the forecast of the nearest position, if it is no further."""
Json = dict[str, Any]


class Forecast(Background[Localizability]):
    """One run's localizability."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> Localizability:
        run = self._run
        route = positions((one.frame for one in run.frames), run.semantic_map)
        return predict(run.semantic_map, run.info.rig.left, route, _conditions(run), self.watch)

    def view(self) -> Json:
        """What the page shows: the values by frame, or how far the work has come."""
        run, predicted = self._run, self.value
        if predicted is None:
            return {"ready": False, "doing": self.doing}
        rows = [_nearest(predicted, one.frame.T_map_camera) for one in run.frames]
        classes = run.semantic_map.classes
        expected, ambiguous = predicted.expected_m.tolist(), predicted.ambiguous.tolist()
        return {
            "ready": True,
            "limits": LIMITS_M,
            "expectedM": [None if row is None else expected[row] for row in rows],
            "ambiguous": [None if row is None else ambiguous[row] for row in rows],
            "meanM": float(predicted.expected_m.mean()),
            "suggested": [
                {
                    "position": _first_frame(one, predicted, rows),
                    "text": f"{new_element(one, predicted, classes)}: {change(one)}",
                }
                for one in predicted.suggested
            ],
        }


class ForecastTopic(Topic):
    """Shows the forecast of the open run where it is asked for."""

    def verbs(self) -> Verbs:
        return {"forecast": self._forecast}

    def on_run(self) -> None:
        self._show()

    def on_theme(self) -> None:
        self._show()

    def _forecast(self, message: Message) -> None:
        desk = self.desk
        run = desk.run
        desk.state = desk.state.showing_forecast(bool(message.get("shown")))
        desk.tell_state()
        if desk.state.forecast:
            self._show()
        else:
            desk.scene.show_forecast(None, run, desk.state)

    def _show(self) -> None:
        """Where it is asked for; worked out first where it is not yet."""
        if self.desk.state.forecast:
            run = self.desk.run
            self.desk.kept(Forecast).ask(lambda: self._got_on(run))

    def _got_on(self, run: Run) -> None:
        """Called in the forecast's thread; the page may show another run by then."""
        desk = self.desk
        with desk.lock:
            if desk.run is not run or not desk.state.forecast:
                return
            forecast = desk.kept(Forecast)
            desk.say("forecast", forecast.view())
            if forecast.value is not None:
                desk.scene.show_forecast(forecast.value, run, desk.state)


def _conditions(run: Run) -> Conditions:
    """Those of the run; where labels or detections were seen, with as much of the map as was."""
    options = options_of(run.info.options)
    stated = conditions_of(options)
    if options.observations == "simulated":
        return stated
    seen = [
        (one.frame.T_map_camera, one.element_id)
        for one in run.frames
        if one.frame.T_map_camera is not None
    ]
    return with_measured_recall(stated, run.semantic_map, run.info.rig.left, seen)


def _first_frame(effect: Effect, predicted: Localizability, rows: list[int | None]) -> int | None:
    """Position in the run of the first frame in which a new element is felt."""
    along_m = [np.nan if row is None else float(predicted.along_m[row]) for row in rows]
    felt = [at for at, along in enumerate(along_m) if effect.first_m <= along <= effect.last_m]
    return felt[0] if felt else None


def _nearest(predicted: Localizability, T_map_camera: Pose | None) -> int | None:
    """Position of the route at which a frame was taken."""
    if T_map_camera is None:
        return None
    centers = np.array([pose.translation for pose in predicted.T_map_camera])
    away = np.linalg.norm(centers - T_map_camera.translation, axis=1)
    row = int(away.argmin())
    return row if away[row] <= NEAR_M else None

"""Show the expected error along a run's route, computed on first request."""

from pathlib import Path

import numpy as np

from semviz.inspector.context import Background, Panel
from semviz.inspector.messages import ShowForecastRequest
from semviz.inspector.views_run import ForecastEvent, ForecastView, SuggestedElement
from semviz.runs.run import Run
from semviz.web.protocol import handles
from semviz.workspace import localizability
from semviz_core.base.pose import Pose
from semviz_core.localizability.element_effects import Effect
from semviz_core.localizability.predict import LIMITS_M, Localizability, predict
from semviz_core.localizability.route import Conditions

NEAR_M = 3.0
"""A frame takes the forecast of the nearest position up to this distance."""


class Forecast(Background[Localizability]):
    """Predicts the localizability of one run's route."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> Localizability:
        run = self._run
        route = localizability.positions((frame.frame for frame in run.frames), run.semantic_map)
        return predict(run.semantic_map, run.info.rig.left, route, _conditions(run), self.watch)

    def view(self) -> ForecastEvent:
        """Return the expected errors by frame, or the progress of the work."""
        forecast = None if self.value is None else _forecast_view(self._run, self.value)
        return ForecastEvent(progress=self.progress, found=forecast)


class ForecastPanel(Panel):
    """Shows the forecast of the open run on request."""

    def on_run(self) -> None:
        self._show()

    def on_theme(self) -> None:
        self._show()

    @handles(ShowForecastRequest)
    def _set_shown(self, request: ShowForecastRequest) -> None:
        context = self.context
        run = context.run
        context.state = context.state.with_forecast(request.shown)
        context.send_state()
        if context.state.forecast:
            self._show()
        else:
            context.scene.show_forecast(None, run, context.state)

    def _show(self) -> None:
        """Send and draw the forecast if it is shown; compute it first if needed."""
        if self.context.state.forecast:
            run = self.context.run
            self.context.cached(Forecast).start(lambda: self._on_progress(run))

    def _on_progress(self, run: Run) -> None:
        """Called in the background thread; the page may show another run by then."""
        context = self.context
        with context.lock:
            if context.run is not run or not context.state.forecast:
                return
            forecast = context.cached(Forecast)
            context.send(forecast.view())
            if forecast.value is not None:
                context.scene.show_forecast(forecast.value, run, context.state)


def _forecast_view(run: Run, predicted: Localizability) -> ForecastView:
    rows = [_nearest(predicted, frame.frame.T_map_camera) for frame in run.frames]
    classes, expected_m = run.semantic_map.classes, predicted.expected_m.tolist()
    suggested = (
        SuggestedElement(
            position=_first_frame(effect, predicted, rows),
            text=f"{localizability.new_element_text(effect, predicted, classes)}: "
            f"{localizability.effect_text(effect)}",
        )
        for effect in predicted.suggested
    )
    return ForecastView(
        limits=LIMITS_M,
        expected_m=tuple(None if row is None else expected_m[row] for row in rows),
        mean_m=float(predicted.expected_m.mean()),
        suggested=tuple(suggested),
    )


def _conditions(run: Run) -> Conditions:
    """Return the run's conditions; its recall is measured unless detections were simulated."""
    options = localizability.options_of(run.info.options)
    stated = localizability.conditions_of(options)
    if options.observations == "simulated":
        return stated
    observations = [
        (frame.frame.T_map_camera, frame.element_id)
        for frame in run.frames
        if frame.frame.T_map_camera is not None
    ]
    return localizability.with_measured_recall(
        stated, run.semantic_map, run.info.rig.left, observations
    )


def _first_frame(effect: Effect, predicted: Localizability, rows: list[int | None]) -> int | None:
    """Return the position of the first frame that a new element improves."""
    along_m = [np.nan if row is None else float(predicted.along_m[row]) for row in rows]
    improved = (
        position
        for position, along in enumerate(along_m)
        if effect.first_m <= along <= effect.last_m
    )
    return next(improved, None)


def _nearest(predicted: Localizability, T_map_camera: Pose | None) -> int | None:
    """Return the row of the route position nearest to a frame; None if it is too far."""
    if T_map_camera is None:
        return None
    centers = np.array([pose.translation for pose in predicted.T_map_camera])
    distance_m = np.linalg.norm(centers - T_map_camera.translation, axis=1)
    row = int(distance_m.argmin())
    return row if distance_m[row] <= NEAR_M else None

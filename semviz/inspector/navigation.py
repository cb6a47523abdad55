"""Open runs and frames, select, and change viewpoint, map colours and backdrop."""

import threading
from dataclasses import replace

import numpy as np

from semviz.inspector import messages
from semviz.inspector.context import Panel
from semviz.inspector.element_card import workspaces_near
from semviz.inspector.scene.scene_map import ELLIPSOID_SCALE
from semviz.inspector.state import State
from semviz.inspector.views import MapColorsEvent, ViewpointEvent
from semviz.web.protocol import BackdropEvent, SetBackdropRequest, SetThemeRequest, handles
from semviz.web.viewpoint import Viewpoint
from semviz.workspace.maps.backdrop import FoundBackdrop, find_backdrop
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError


class NavigationPanel(Panel):
    """The requests that every page needs."""

    @handles(messages.OpenRunRequest)
    def _open(self, request: messages.OpenRunRequest) -> None:
        context = self.context
        context.state = context.state.with_theme(request.theme)
        context.open(request.run or context.library.names[0], request.frame)

    @handles(messages.GoToPositionRequest)
    def _go(self, request: messages.GoToPositionRequest) -> None:
        self.context.state = self.context.state.at(request.position, self.context.run)
        self.context.send_frame()

    @handles(messages.DrawFrameRequest)
    def _draw(self, _: messages.DrawFrameRequest) -> None:
        self.context.draw_frame()

    @handles(messages.SelectRequest)
    def _select(self, request: messages.SelectRequest) -> None:
        self.context.select(request.observed, request.element)

    @handles(messages.SetViewRequest)
    def _set_view(self, request: messages.SetViewRequest) -> None:
        context = self.context
        context.state = context.state.with_view(request.view)
        context.send_state()
        context.scene.set_view(context.run, context.state)

    @handles(SetThemeRequest)
    def _set_theme(self, request: SetThemeRequest) -> None:
        context = self.context
        context.state = context.state.with_theme(request.theme)
        if context.is_open:
            context.draw_run()
            for panel in context.panels:
                panel.on_theme()

    @handles(messages.ShowAlternativesRequest)
    def _show_alternatives(self, request: messages.ShowAlternativesRequest) -> None:
        context = self.context
        context.state = context.state.with_alternatives(request.shown)
        context.send_state()
        context.draw_frame()


PRELOAD_DELAY_S = 0.1
"""Preloading waits so that it does not delay the frame that is shown."""


class ViewpointPanel(Panel):
    """Viewpoints and colours of the 3D map. Sends the map's legend whenever it changes."""

    def on_run(self) -> None:
        self._send_legend()

    def on_theme(self) -> None:
        self._send_legend()

    def on_drawn(self) -> None:
        timer = threading.Timer(PRELOAD_DELAY_S, self._preload, args=(self.context.state,))
        timer.daemon = True
        timer.start()

    def _preload(self, drawn: State) -> None:
        """Preload neighbouring images, unless the page has moved on. Called in a timer thread."""
        context = self.context
        with context.lock:
            if (context.state.run, context.state.position) == (drawn.run, drawn.position):
                context.scene.preload_images(context.state)

    @handles(messages.SetMapColorsRequest)
    def _set_map_colors(self, request: messages.SetMapColorsRequest) -> None:
        context, state = self.context, self.context.state
        ellipsoids = state.ellipsoids if request.ellipsoids is None else request.ellipsoids
        context.state = state.with_map_colors(request.colors or state.colors, ellipsoids)
        context.send_state()
        context.scene.recolor(context.run, context.state)
        self._send_legend()

    def _send_legend(self) -> None:
        context = self.context
        magnified = ELLIPSOID_SCALE if context.state.ellipsoids else None
        context.send(
            MapColorsEvent(legend=context.scene.legend(context.state), magnified=magnified)
        )

    @handles(messages.GetViewpointRequest)
    def _send_viewpoint(self, request: messages.GetViewpointRequest) -> None:
        viewpoint = self.context.scene.viewpoint()
        eye, target = _rounded(viewpoint.eye_m), _rounded(viewpoint.target_m)
        self.context.send(ViewpointEvent(reply_to=request.id, eye=eye, target=target))

    @handles(messages.GoToViewpointRequest)
    def _go_to_viewpoint(self, request: messages.GoToViewpointRequest) -> None:
        context = self.context
        viewpoint = Viewpoint(np.array(request.eye), np.array(request.target))
        if np.linalg.norm(viewpoint.eye_m - viewpoint.target_m) < 1e-3:
            raise SemvizError("eye and target of this viewpoint coincide; delete and save it again")
        context.state = replace(context.state, view="free")
        context.send_state()
        context.scene.go_to(viewpoint, context.run, context.state)


def _rounded(point_m: FloatArray) -> tuple[float, float, float]:
    x, y, z = point_m.tolist()
    return round(x, 3), round(y, 3), round(z, 3)


class BackdropPanel(Panel):
    """Finds the backdrop in the run's workspace, for each opened run and at each request."""

    def on_run(self) -> None:
        self._show()

    @handles(SetBackdropRequest)
    def _set_shown(self, request: SetBackdropRequest) -> None:
        self.context.state = self.context.state.with_backdrop(request.shown)
        self._show(request.id)
        self.context.send_state()

    def _show(self, reply_to: str | None = None) -> None:
        found = self._found()
        self.context.scene.show_backdrop(found.backdrop, self.context.state)
        available = found.backdrop is not None
        self.context.send(BackdropEvent(reply_to=reply_to, available=available, note=found.note))

    def _found(self) -> FoundBackdrop:
        run, path = self.context.run, self.context.library.path(self.context.state.run)
        workspace = next(workspaces_near(run, path), None)
        frames = (record.frame for record in run.frames)
        return find_backdrop(workspace, run.semantic_map.frame, run.info.rig, frames)

"""Show the backdrop of a run's drive, or say why there is none."""

from semviz.inspector.context import Panel
from semviz.inspector.element_card import workspaces_near
from semviz.web.protocol import BackdropEvent, SetBackdropRequest, handles
from semviz.workspace.backdrop import FoundBackdrop, find_backdrop


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

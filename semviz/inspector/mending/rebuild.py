"""A run's map built again from its labels and the run with it, while pages go on."""

from pathlib import Path

from semviz.comparing.comparison import frame_change
from semviz.inspector.background import Background
from semviz.mending import mend_run
from semviz.recording.run import Run
from semviz.trying.over import free_path, in_words
from semviz.workspace import Workspace
from semviz_core.errors import SemvizError


class Rebuild(Background[Path]):
    """Its value is the file of the new run, beside the old one."""

    def __init__(self, run: Run, path: Path, workspace: Workspace) -> None:
        super().__init__()
        self._run = run
        self._path = path
        self._workspace = workspace
        self.said = ""
        """What came of it, in words; empty until it is over."""

    def work(self) -> Path:
        path = free_path(self._path, "mended")
        mended = mend_run(self._run, path, self._workspace, self._got_on)
        both = zip(self._run.frames, mended.frames, strict=True)
        self.said = in_words([frame_change(before, after) for before, after in both])
        return path

    def _got_on(self, what: str, done: int, of: int) -> None:
        if self.is_stopped:
            raise SemvizError("Stopped; nothing was changed.")
        self.tell_doing(f"{what}: {done} of {of}")

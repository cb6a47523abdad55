"""Compare the poses of a workspace with its images, in a thread of its own.

Measuring takes a third of a second a frame, so it starts when a page asks for it; what was
measured before is shown at once.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from semviz.annotator.pose_views import PosesView, poses_view
from semviz.workspace.pose_check import check_poses, known_check
from semviz.workspace.pose_review import PoseFindings, PoseReview
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import frames_of_camera
from semviz_core.pose_checks.faults import PoseCheck

PoseState: TypeAlias = Literal["unknown", "working", "ready", "failed"]


@dataclass(frozen=True)
class PoseProgress:
    """How far the comparison is."""

    state: PoseState = "unknown"
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    failure: str = ""


class PoseWork:
    """Checks poses in a thread. Any thread may read the results: they are replaced whole."""

    def __init__(self, workspace: Workspace, labels: Callable[[], Labels]) -> None:
        self._workspace = workspace
        self._labels = labels
        self._pool = ThreadPoolExecutor(1, "semviz-poses")
        self._stopping = False
        self._began = 0.0
        self._check: PoseCheck | None = None
        self.progress = PoseProgress()
        self.review: PoseReview | None = None
        self.view: PosesView | None = None
        """Of ``review``."""
        self.version = 0
        """Changes whenever one of these changes."""

    def look_up(self) -> None:
        """Show what was measured before, if anything, with the choices of now; measure nothing."""
        self._pool.submit(self._run, lambda: self._check or known_check(self._workspace))

    def start(self) -> None:
        """Measure, unless that is done or under way; with changed labels, look again."""
        if self.progress.state == "working":
            return
        is_same = self.review is not None and self.review.labels == self._labels()
        if self.progress.state == "ready" and is_same:
            return
        self._began = time.monotonic()
        self._set(replace(self.progress, state="working", done=0, total=0, failure=""))
        self._pool.submit(self._run, self._measured)

    def close(self) -> None:
        """Stop soon, and wait for the thread."""
        self._stopping = True
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _set(self, progress: PoseProgress) -> None:
        self.progress = progress
        self.version += 1

    def _measured(self) -> PoseCheck:
        if self._check is None:
            frames = frames_of_camera(self._workspace.given_source, None)
            self._check = check_poses(self._workspace, frames, self._on_progress)
        return self._check

    def _run(self, find: Callable[[], PoseCheck | None]) -> None:
        try:
            self._check = find()
            if self._check is None:
                self._set(PoseProgress())
                return
            review = PoseReview(self._findings(self._check), self._workspace.pose_choices())
            view = poses_view(review)
            self.review, self.view = review, view
            self._set(PoseProgress("ready"))
        except SemvizError as error:
            self._set(PoseProgress("failed", failure=str(error)))
        except Exception as error:  # nothing else reports errors of this thread
            self._set(PoseProgress("failed", failure=f"poses: {error!r}; please report this"))

    def _findings(self, check: PoseCheck) -> PoseFindings:
        """Return what images and labels say; the same as before if the labels are the same."""
        labels = self._labels()
        before = None if self.review is None else self.review.findings
        if before is not None and before.check is check and before.labels == labels:
            return before
        return PoseFindings(self._workspace, check, labels)

    def _on_progress(self, what: str, done: int, total: int) -> None:
        if self._stopping:
            raise SemvizError("Stopped: nothing was changed.")
        self._set(PoseProgress("working", done, total, time.monotonic() - self._began))

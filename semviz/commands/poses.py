"""The commands poses check, refine and choose."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.poses.pose_choices import Choice, PoseOperation, Subject
    from semviz.workspace.poses.pose_review import PoseReview
    from semviz.workspace.workspace import Workspace
    from semviz_core.pose_checks.faults import PoseCheck


@dataclass(frozen=True)
class PosesCheckCommand:
    """Check poses and stereo calibration against the images, and name what is wrong. Changes
    nothing. Poses are checked as they are used, with the choices of 'poses choose'.

    Example: 'semviz poses check town'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: check only these frames."""
    camera: parsing.OptionalText = None
    """Of a rig: the camera whose poses are checked; default: the first."""
    plot: parsing.OptionalPath = None
    """Also write a plot over the frames to this PNG file."""
    gate: bool = False
    """Exit with status 1 if a fault is found."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object with every pair of frames instead of text."""

    def run(self) -> int:
        from semviz.reports.pose_check import check_text, choice_lines, draw_check
        from semviz.workspace.poses.pose_labels import label_evidence

        _check_plot(self.plot, self.workspace, self.force)
        check = _checked(self.workspace, self.frames, self.camera)
        workspace = parsing.open_workspace(self.workspace)
        labels, source = workspace.read_labels(), workspace.source
        evidence = [label_evidence(labels, source, check, fault) for fault in check.faults]
        if self.json:
            result = check.as_dict()
            for fault, said in zip(result["faults"], evidence, strict=True):
                fault["labels"] = None if said is None else asdict(said)
            result["choices"] = [one.as_dict() for one in workspace.pose_choices().present]
            print(json.dumps(result))
        else:
            print(check_text(check, ["" if said is None else str(said) for said in evidence]))
            for line in choice_lines(workspace):
                print(line)
        if self.plot is not None:
            draw_check(check, self.plot)
        return 1 if self.gate and check.faults else 0


@dataclass(frozen=True)
class PosesRefineCommand:
    """Write poses refined by the images to a file for 'semviz new --poses'. The workspace does not
    change.

    Example: 'semviz poses refine town --out refined.txt'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    out: Path
    """File to write."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: only these frames."""
    camera: parsing.OptionalText = None
    """Of a rig: the camera whose images refine the poses; default: the first. The file holds those
    of the first camera, as 'semviz new --poses' takes them."""
    format: Literal["tum", "kitti"] = "tum"
    """tum: time and pose, z up; kitti: one pose per line, in KITTI's axes, all frames needed."""
    plot: parsing.OptionalPath = None
    """Also write a plot over the frames to this PNG file."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object with the move of every frame instead of text."""

    def run(self) -> int:
        from semviz.reports.pose_check import draw_check
        from semviz.workspace import outputs
        from semviz_core.datasets.rig_cameras import in_first_camera
        from semviz_core.datasets.trajectory import save_trajectory
        from semviz_core.pose_checks.faults import refined_frames

        outputs.check_outputs(
            self.out, outputs.never, force=self.force, reads=_files_read(self.workspace)
        )
        _check_plot(self.plot, self.workspace, self.force)
        check = _checked(self.workspace, self.frames, self.camera)
        source = parsing.open_workspace(self.workspace).given_source
        refined = in_first_camera(source, refined_frames(check))
        save_trajectory(refined, self.out, self.format)
        if self.plot is not None:
            draw_check(check, self.plot)
        moves = _moves(check)
        if self.json:
            faults = check.as_dict()["faults"]
            print(json.dumps({"file": str(self.out), "faults": faults, "moves": moves}))
        else:
            print(_moves_text(check, moves))
            print(f"{self.out}: {len(moves)} poses; use it: semviz new FOLDER --poses {self.out}")
        return 0


_STEPS: "dict[str, Literal[-1, 1]]" = {"undo": -1, "redo": 1}


@dataclass(frozen=True)
class PosesChooseCommand:
    """Choose what to do with wrong poses: everything after it (annotate, map build, localize) then
    uses refined poses, or leaves those frames out. The drive's own file is never changed.

    Example: 'semviz poses choose town refine'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    choice: Positional[Literal["refine", "leave-out", "keep", "ask", "undo", "redo"]]
    """refine: use poses refined by the images; leave-out: use no pose; keep: use the given poses,
    and do not warn again; ask: as if nothing was chosen; undo, redo: step through the choices."""
    frames: parsing.OptionalText = None
    """FIRST:END: choose for these frames; default: for every fault that is still open (ask: for
    every choice)."""
    author: parsing.OptionalText = None
    """Name in the record; default: your login name."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.reports.pose_check import choice_text
        from semviz.workspace.poses.pose_review import step_choices

        workspace = parsing.open_workspace(self.workspace)
        if self.choice in _STEPS:
            if self.frames is not None:
                raise SemvizError(f"--frames is not for {self.choice}; leave it out")
            made = [step_choices(workspace, _STEPS[self.choice])]
        else:
            made = self._choose(workspace)
        if self.json:
            choices = [one.as_dict() for one in made]
            print(json.dumps({"choice": self.choice, "operations": choices}))
        elif not made:
            print("no fault is open: there is nothing to choose")
        for one in () if self.json else made:
            word = f"{self.choice}: " if self.choice in _STEPS else ""
            print(f"{word}{choice_text(one)}")
        return 0

    def _choose(self, workspace: "Workspace") -> "list[PoseOperation]":
        from semviz.presentation.terminal import Steps
        from semviz.workspace.poses.pose_review import PoseReview, check_poses, choose_poses
        from semviz.workspace.settings import login_name
        from semviz_core.datasets.rig_cameras import frames_of_camera

        choice: Choice = "leave out" if self.choice == "leave-out" else self.choice  # type: ignore[assignment]
        author = self.author or login_name()
        with Steps() as steps:
            frames = frames_of_camera(workspace.given_source, None)
            check = check_poses(workspace, frames, steps.show)
        made: list[PoseOperation] = []
        while True:
            review = PoseReview.of(workspace, check, workspace.read_labels())
            wanted = self._stretches(review) if not made or self.frames is None else []
            if not wanted:
                return made
            made.append(choose_poses(review, choice, wanted[0], author))

    def _stretches(self, review: "PoseReview") -> "list[tuple[int, int, Subject]]":
        """Return the stretches to choose for, with what the choice is about."""
        frames = parsing.parse_frames(self.frames)
        if frames is not None and frames.step != 1:
            raise SemvizError(f"--frames {self.frames}: a stretch has no steps; write FIRST:END")
        if frames is not None:
            return [(frames.start, frames.stop - 1, "frames")]
        wanted = review.open
        if self.choice == "ask":
            wanted = tuple(one for one in review.stretches if review.choice_for(one) is not None)
        elif self.choice == "refine":
            wanted = tuple(one for one in wanted if one.can_refine)
        elif self.choice == "leave-out":
            wanted = tuple(one for one in wanted if one.subject == "frames")
        return [(one.fault.first, one.fault.last, one.subject) for one in wanted]


def known_pose_review(workspace: "Workspace") -> "PoseReview | None":
    """Return the faults of poses that an earlier check of all frames measured; None without one."""
    from semviz.workspace.poses.pose_review import PoseReview, known_check

    check = known_check(workspace)
    return None if check is None else PoseReview.of(workspace, check, workspace.read_labels())


def _checked(path: Path, frames: str | None, camera: str | None) -> "PoseCheck":
    from semviz.presentation.terminal import Steps
    from semviz.workspace.chosen_frames import select_frames
    from semviz.workspace.poses.pose_review import check_poses

    workspace = parsing.open_workspace(path)
    chosen = select_frames(workspace.source, parsing.parse_frames(frames), camera)
    with Steps() as steps:
        return check_poses(workspace, chosen, steps.show)


def _check_plot(plot: Path | None, workspace: Path, force: bool) -> None:
    """Before seconds of work: SemvizError for a plot that would be refused."""
    from semviz.reports.pose_check import check_plot_path
    from semviz.workspace import outputs

    if plot is not None:
        check_plot_path(plot)
        outputs.check_outputs(plot, outputs.PNG, force=force, reads=[workspace])


def _files_read(path: Path) -> list[Path]:
    """Return what a refinement reads and must not replace: the workspace and its pose file."""
    from semviz.workspace.settings import KittiSettings

    settings = parsing.open_workspace(path).settings.source
    if not isinstance(settings, KittiSettings):
        return [path]
    root = (path.resolve() / settings.root).resolve()
    files = [root / "poses" / f"{settings.sequence}.txt"]
    if settings.poses is not None:
        files.append((path.resolve() / settings.poses).resolve())
    return [path, *files]


def _moves(check: "PoseCheck") -> list[dict[str, Any]]:
    """Return what refining moves, per frame with a pose."""
    import numpy as np

    refinement = check.refinement
    turn = np.rad2deg(np.linalg.norm(refinement.turn_rad, axis=1))
    shift = np.linalg.norm(refinement.shift_m, axis=1)
    return [
        {
            "frame": frame.index,
            "turn_deg": round(float(turn[row]), 4),
            "shift_m": round(float(shift[row]), 4),
            "sigma_deg": round(float(np.rad2deg(refinement.sigma_rad[row])), 4),
            "sigma_m": round(float(refinement.sigma_m[row]), 4),
            "from_images_alone": not bool(refinement.held[row]),
        }
        for row, frame in enumerate(check.frames)
        if refinement.poses.known[row]
    ]


def _moves_text(check: "PoseCheck", moves: list[dict[str, Any]]) -> str:
    import numpy as np

    lines = [fault.text for fault in check.faults] or ["no fault found"]
    turn = np.array([move["turn_deg"] for move in moves])
    shift = np.array([move["shift_m"] for move in moves])
    alone = sum(move["from_images_alone"] for move in moves)
    lines.append(
        f"moved: median {np.median(turn):.3f} deg, {100.0 * np.median(shift):.1f} cm; at most "
        f"{turn.max():.2f} deg, {shift.max():.2f} m; {alone} poses from images alone"
    )
    return "\n".join(lines)

"""The commands annotate, serve and open."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from tyro.conf import FlagCreatePairsOff, Positional

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.web.tool import Tool

Role: TypeAlias = Literal["annotate", "review", "look"]
TOKEN_VARIABLE = "SEMVIZ_TOKEN"


@dataclass(frozen=True)
class AnnotateCommand:
    """Label poles and signs in the left and right images of a workspace, in the browser.

    Example: 'semviz annotate town'."""

    workspace: Positional[parsing.OptionalPath] = None
    """Workspace; default: the built-in demo."""
    author: parsing.OptionalText = None
    """Author of the edits in the history; default: your login name."""
    host: str = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this machine, 0.0.0.0 all machines."""
    port: int = 8081
    """Port to listen on; 0 selects a free one."""
    token: parsing.OptionalText = None
    """Access token; default: the environment variable SEMVIZ_TOKEN, or else a random one. Other
    users of this machine can read the command line."""
    no_token: FlagCreatePairsOff[bool] = False
    """Serve without a token: all users of this machine can open the page. Loopback only."""
    open: bool = True
    """Open the page in the browser."""
    invite: parsing.OptionalText = None
    """Instead of opening: make a token for a person, and print the address to send. Works while
    semviz annotate runs."""
    role: Role = "annotate"
    """Of who is invited: annotate; review, which may annotate, too; or look."""
    revoke: parsing.OptionalText = None
    """Instead of opening: end the access of a person, at once."""

    def run(self) -> int:
        if self.invite is not None or self.revoke is not None:
            return self._change_people()
        from semviz.annotator.team.blind_annotator import TeamAnnotator
        from semviz.presentation.terminal import announce_compiling
        from semviz.workspace.demo import ensure_demo

        announce_compiling("snapping to edges")
        folder = self.workspace if self.workspace is not None else ensure_demo()
        tool = TeamAnnotator(parsing.open_workspace(folder), author=self.author)
        if left_out := tool.session.left_out_proposals:
            print(
                f"warning: {left_out} proposed triangular signs are left out: their middle is "
                "another than that of the labels, and their height is not known; detect again",
                file=sys.stderr,
            )
        _serve(tool, self, tool.people.names_by_digest)
        return 0

    def _change_people(self) -> int:
        from urllib.parse import quote

        from semviz.workspace.people import People
        from semviz.workspace.settings import login_name

        if self.workspace is None:
            raise SemvizError("say whose labels: semviz annotate WORKSPACE --invite NAME")
        workspace = parsing.open_workspace(self.workspace)
        author, people = self.author or login_name(), People(workspace.path)
        if self.revoke is not None:
            people.revoke(self.revoke)
        elif self.invite == author:
            raise SemvizError(f"'{author}' is your own name; the printed address is yours")
        with workspace.open_labels() as store:
            if self.revoke is not None:
                store.state("revoke", self.revoke, author)
                print(f"{self.revoke} can no longer enter.")
                return 0
            assert self.invite is not None
            token = people.invite(self.invite, self.role)
            store.state("invite", f"{self.invite} to {self.role}", author)
        print(f"Send this address to {self.invite}; it is shown only now:")
        print(f"http://{self.host}:{self.port}/?token={quote(token, safe='')}")
        return 0


@dataclass(frozen=True)
class ServeCommand:
    """Inspect runs in the browser: map, cameras, images, correspondences, errors and diagnosis.

    Examples: 'semviz serve' (the demo); 'semviz serve town'."""

    paths: Positional[tuple[Path, ...]] = ()
    """Workspaces, runs (.rrd), folders of runs or batches; default: the built-in demo."""
    host: str = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this machine, 0.0.0.0 all machines."""
    port: int = 8080
    """Port to listen on; 0 selects a free one."""
    token: parsing.OptionalText = None
    """Access token; default: the environment variable SEMVIZ_TOKEN, or else a random one. Other
    users of this machine can read the command line."""
    no_token: FlagCreatePairsOff[bool] = False
    """Serve without a token: all users of this machine can open the page. Loopback only."""
    open: bool = True
    """Open the page in the browser."""

    def run(self) -> int:
        from contextlib import closing

        from semviz.inspector.server import Inspector
        from semviz.presentation.terminal import announce_compiling
        from semviz.workspace.demo import ensure_demo

        announce_compiling()
        with closing(Inspector(find_runs(self.paths or (ensure_demo(),)))) as tool:
            _serve(tool, self)
        return 0


def find_runs(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Return the runs in ``paths``: .rrd files, all runs of workspaces, oldest first, and those in
    other folders or their folders ``runs``, such as a batch has, by name.

    Raise SemvizError if a path is nothing of that, or a workspace has no runs.
    """
    from semviz.runs.reader import check_run_file
    from semviz.workspace.settings import SETTINGS
    from semviz.workspace.workspace import Workspace

    runs: list[Path] = []
    for path in paths:
        if path.is_file() or path.suffix == ".rrd":
            check_run_file(path)
            runs.append(path)
        elif not (path / SETTINGS).is_file() and (found := _runs_in(path)):
            runs += found
        else:
            workspace = Workspace.open(path)
            if not workspace.runs():
                raise SemvizError(f"{path}: no runs yet; run 'semviz localize {path}'")
            runs += [workspace.run_path(name) for name in workspace.runs()]
    return tuple(runs)


def _runs_in(folder: Path) -> list[Path]:
    found = sorted(folder.glob("*.rrd")) or sorted(folder.glob("runs/*.rrd"))
    return [run for run in found if not run.name.startswith(".")]


def _serve(
    tool: "Tool",
    command: AnnotateCommand | ServeCommand,
    guests: "Callable[[], Mapping[str, str]] | None" = None,
) -> None:
    from semviz.web.access import nobody
    from semviz.web.gateway import Gateway

    token = command.token
    if token is None and not command.no_token:
        token = os.environ.get(TOKEN_VARIABLE) or None
    gateway = Gateway(
        tool,
        command.host,
        command.port,
        token,
        with_token=not command.no_token,
        guests=guests or nobody,
    )
    gateway.run(open_browser=command.open)


@dataclass(frozen=True)
class OpenRunCommand:
    """Open a run in rerun's viewer.

    Example: 'semviz open town/runs/search.rrd'."""

    run_file: Positional[Path]
    """Run (.rrd)."""

    def run(self) -> int:
        from semviz.runs.reader import check_run_file

        check_run_file(self.run_file)
        viewer = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1"]
        return subprocess.call([*viewer, str(self.run_file)])

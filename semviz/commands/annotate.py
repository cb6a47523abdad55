"""semviz annotate"""

from dataclasses import dataclass

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath, OptionalText


@dataclass(frozen=True)
class Annotate:
    """Label poles and signs of a workspace in the browser, left and right."""

    workspace: Positional[OptionalPath] = None
    """A workspace, made with 'semviz new'; the demo street if none."""
    author: OptionalText = None
    """Name under which operations are stored; the login name if not given."""
    host: str = "127.0.0.1"
    """Address to listen on; any but loopback demands the token that is printed."""
    port: int = 8081
    """Port to listen on; 0 takes a free one."""
    token: OptionalText = None
    """Secret that browsers must bring; made up if needed and not given."""
    open: bool = True
    """Open the page in the browser."""

    def run(self) -> int:
        from semviz.annotator.server import Annotator
        from semviz.demo import ensure_demo
        from semviz.web.door import Door
        from semviz.workspace import Workspace

        folder = self.workspace if self.workspace is not None else ensure_demo()
        tool = Annotator(Workspace.open(folder), author=self.author)
        Door(tool, host=self.host, port=self.port, token=self.token).run(open_browser=self.open)
        return 0

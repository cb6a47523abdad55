"""semviz serve"""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalText


@dataclass(frozen=True)
class Serve:
    """See runs in the browser: map, cameras, images, matches, errors, and why a frame failed."""

    paths: Positional[tuple[Path, ...]] = ()
    """Workspaces or runs (.rrd); the built-in demo if none."""
    host: str = "127.0.0.1"
    """Address to listen on; any but loopback demands the token that is printed."""
    port: int = 8080
    """Port to listen on; 0 takes a free one."""
    token: OptionalText = None
    """Secret that browsers must bring; made up if needed and not given."""
    open: bool = True
    """Open the page in the browser."""

    def run(self) -> int:
        from contextlib import closing

        from semviz.demo import ensure_demo
        from semviz.inspector.server import Inspector
        from semviz.progress import tell_of_compiling
        from semviz.web.door import Door
        from semviz.workspace import find_runs

        tell_of_compiling()
        with closing(Inspector(find_runs(self.paths or (ensure_demo(),)))) as tool:
            Door(tool, host=self.host, port=self.port, token=self.token).run(open_browser=self.open)
        return 0

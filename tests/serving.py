"""Starting the web tools as a person does: by their command, until the address is printed."""

import re
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def serving(
    command: Sequence[str | Path], environment: dict[str, str], folder: Path | None = None
) -> Iterator[str]:
    """The address that ``command`` prints, on a free port and without opening a browser."""
    process = subprocess.Popen(
        [*command, "--no-open", "--port", "0"],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    found = filter(None, (re.search(r"http://\S+", line) for line in process.stdout))
    try:
        address = next(found, None)
        assert address is not None, f"{command}: ended without an address"
        yield address.group()
    finally:
        process.terminate()
        process.wait(timeout=30)

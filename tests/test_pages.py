"""The pages' scripts in node, where it is there: what needs no browser."""

import re
import shutil
import subprocess
from pathlib import Path

from conftest import REPOSITORY, skip_or_fail

LEAST_NODE = (18, 19)
"""From this version on it runs tests and can be told where ``/static/`` lies."""


def node() -> str:
    """The node to run; the test skips, or fails, where there is none that is new enough."""
    found = shutil.which("node")
    if found is None:
        skip_or_fail("node is not installed; apt install nodejs")
    version = subprocess.run(
        [found, "--version"], capture_output=True, text=True, check=True
    ).stdout
    major, minor = map(int, re.findall(r"\d+", version)[:2])
    if (major, minor) < LEAST_NODE:
        skip_or_fail(f"node is {version.strip()}; the tests of the pages need 18.19 or later")
    return found


def test_the_scripts_do_what_their_own_tests_say() -> None:
    files = sorted(map(str, (REPOSITORY / "tests" / "js").glob("*.test.js")))
    assert files
    command = [node(), "--import", "./tests/js/resolve.js", "--test", *files]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    ran = re.search(r"^# pass (\d+)$|^ℹ pass (\d+)$", done.stdout, re.MULTILINE)
    assert ran
    assert int(ran[1] or ran[2]) > 0


def test_every_script_is_checked() -> None:
    """By tsc: strictly, and none of them asks to be left out."""
    pages = [
        path
        for folder in ("web/static", "annotator/page", "inspector/page")
        for path in (REPOSITORY / "semviz" / folder).rglob("*.js")
    ]
    assert len(pages) > 50
    unchecked = [page.name for page in pages if not is_checked(page)]
    assert unchecked == []


def is_checked(script: Path) -> bool:
    text = script.read_text()
    return text.startswith("// @ts-check\n") and not re.search(r"@ts-(nocheck|ignore|expect)", text)

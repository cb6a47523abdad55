"""Every command and every link in the README and in docs/ works as it is written."""

import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from labelled_kitti import write_model
from serving import fetch, serving

from semviz.cli import main

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
SETUP = ("python -m venv", ". ", "pip install", "pytest")
"""Lines that make the environment; .ci/run and test_packaging do the same."""
SERVERS = ("serve", "annotate")
MODEL = "models/espnet.toml"
"""A network that its readers export; here one that knows our labels."""


def commands_of(page: Path) -> list[str]:
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    return [line.strip() for block in blocks for line in block.splitlines() if line.strip()]


COMMAND_PAGES = [page for page in PAGES if commands_of(page)]


def name_of(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


def semviz(words: list[str]) -> None:
    """Run a command in this process, which has imported and compiled already."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code, shlex.join(["semviz", *words])


def run(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{shlex.join(words)}\n{done.stdout}\n{done.stderr}"


def start_and_ask(command: str, environment: dict[str, str], folder: Path | None = None) -> None:
    """Start a server as documented and ask for its page."""
    with serving(shlex.split(command), environment, folder) as address:
        assert b"semviz" in fetch(address)


@cache
def serve_demo(environment: tuple[tuple[str, str], ...]) -> None:
    """``semviz serve``, once for all pages that have it."""
    start_and_ask("semviz serve", dict(environment))


@pytest.mark.realdata
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", COMMAND_PAGES, ids=name_of)
def test_commands_of_page(
    page: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    environment: dict[str, str],
    kitti_root: Path,
) -> None:
    (tmp_path / "docs").symlink_to(REPOSITORY / "docs")
    if any(MODEL in command for command in commands_of(page)):
        write_model(tmp_path / MODEL, kitti_root)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", environment["XDG_CACHE_HOME"])
    for line in commands_of(page):
        for command in line.replace("/data/kitti", str(kitti_root)).split("&&"):
            command = command.split(" #")[0].strip()
            if command.startswith(SETUP):
                continue
            program, *words = shlex.split(command)
            if program == "python":
                run([sys.executable, *words], tmp_path, environment)
            elif words == ["serve"]:
                serve_demo(tuple(environment.items()))
            elif words[0] in SERVERS and not {"--invite", "--revoke"} & set(words):
                start_and_ask(command, environment, tmp_path)
            elif words[0] == "open":
                verify = [sys.executable, "-m", "rerun", "rrd", "verify", words[1]]
                run(verify, tmp_path, environment)
            else:
                semviz(words)


def test_every_documented_line_is_known() -> None:
    """A command this test would silently skip must not creep into the docs."""
    first_words = {
        command.strip().split(" #")[0].split()[0]
        for page in COMMAND_PAGES
        for line in commands_of(page)
        for command in line.split("&&")
    }
    assert first_words <= {"semviz", "python", ".", "pip", "pytest"}


def text_of(page: Path) -> str:
    """Without blocks and spans of code, which hold neither links nor headings."""
    without_blocks = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    return re.sub(
        r"^(?!#)(.*)$", lambda line: re.sub(r"`[^`]*`", "", line[0]), without_blocks, flags=re.M
    )


def anchors_of(page: Path) -> set[str]:
    """The anchors that GitHub makes of the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "CHANGELOG.md"], ids=name_of)
def test_relative_links_resolve(page: Path) -> None:
    """Files exist, and so do the headings that an anchor names."""
    for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{link}: no such file"
        assert target.is_relative_to(REPOSITORY), f"{link}: outside of the repository"
        assert not anchor or anchor in anchors_of(target), f"{link}: no such heading"


def test_every_picture_is_shown_and_has_a_maker() -> None:
    """docs/make_screenshots.py names the pictures that it takes, and who plots the others."""
    makers = (REPOSITORY / "docs" / "make_screenshots.py").read_text()
    shown = "".join(page.read_text() for page in PAGES)
    pictures = sorted(path.name for path in (REPOSITORY / "docs" / "images").iterdir())
    assert len(pictures) > 10
    assert [name for name in pictures if f'"{name}"' not in makers] == []
    assert [name for name in pictures if f"images/{name})" not in shown] == []


def python_of(page: Path) -> str:
    return "\n".join(re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S))


@pytest.mark.timeout(600)
def test_python_of_the_docs(tmp_path: Path, environment: dict[str, str]) -> None:
    """The blocks of a page are one script; its first example finds the camera where it is."""
    done = subprocess.run(
        [sys.executable, "-c", python_of(REPOSITORY / "docs" / "python.md")],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    status, centre, _, recorded, *frames = done.stdout.splitlines()
    assert status.startswith("ok ")
    numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*", centre)]
    assert all(abs(have - want) < 0.01 for have, want in zip(numbers, (0, 0, 1.65), strict=True))
    assert recorded.startswith("recorded: ")
    assert len(frames) == 3

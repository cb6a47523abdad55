"""The project's words: README, docs and command help keep to the terms of the field."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import call

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
PACKAGES = ("semviz", "core/semviz_core", "annotation/semviz_annotation")

INSTEAD = {
    r"verdicts?": "diagnosis, status, review decision or outcome",
    r"mend(s|ed|ing)?": "fix, repair or rebuild",
    r"things?": "landmark, element or object",
    r"crews?": "process group",
    r"drill(s|ed)?": "training sample",
    r"partners?": "correspondence or match",
    r"misfits?": "outlier",
    r"strangers?": "unmatched detection",
    r"sightings?": "observation",
    r"judge?ments?": "review decision",
    r"finders?": "detector or model",
    r"sure[ _-]and[ _-]wrong": "overconfident",
    r"nothing real": "false positive",
    r"(if not|unless) given": "default: ...",
    r"(has|have) the say": "name the actor",
}
"""Banned words, as regular expressions, and what to write instead."""

ROW = 200
"""Characters of a table's row."""

KEPT = (
    "share_sure_and_wrong",  # a metric in --json, --csv and --fail-if
    "NAME-mended-1.rrd",  # name of a run that `semviz serve` writes
    "more kinds of things",  # keys in --json of imports and exports
    "things of a class that is ignored, as asked",
)
"""Stored and public names that keep a banned word."""

RECORDS = (DOCS / "decisions",)
"""Pages that keep their words."""

_BANNED = {
    re.compile(rf"(?<![a-z])(?:{words})(?![a-z])", re.IGNORECASE): instead
    for words, instead in INSTEAD.items()
}


def faults(text: str) -> list[str]:
    """The banned words of ``text``, each with its surroundings and what to write instead."""
    for name in KEPT:
        text = text.replace(name, "")
    text = " ".join(text.split())
    return [
        f"...{text[max(0, found.start() - 40) : found.end() + 30]}...: write {instead}"
        for banned, instead in _BANNED.items()
        for found in banned.finditer(text)
    ]


def prose_of(page: Path) -> str:
    """A page without targets of links, and without Python, whose names are checked as names."""
    text = re.sub(r"^```python\n.*?^```", "", page.read_text(), flags=re.M | re.S)
    return re.sub(r"\]\([^)\s]*\)", "]", text)


def pages() -> list[Path]:
    every = [REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
    return [page for page in every if not any(page.is_relative_to(path) for path in RECORDS)]


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_pages(page: Path) -> None:
    assert not faults(prose_of(page))


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_rows_of_tables_are_short(page: Path) -> None:
    long = [line for line in page.read_text().splitlines() if line[:1] == "|" and len(line) > ROW]
    assert not long, f"more than {ROW} characters: write a list, or a paragraph"


def test_command_help(capsys: pytest.CaptureFixture[str]) -> None:
    """Every command's --help; the usage line of a group names the commands below it."""
    groups: list[tuple[str, ...]] = [()]
    read = []
    while groups:
        words = groups.pop()
        status, text, _ = call(capsys, *words, "--help")
        assert status == 0
        plain = re.sub(r"[│╭╮╰╯─]", " ", text)  # the frame breaks phrases
        assert not faults(plain), " ".join(words)
        below = re.search(r"usage: [\w ]+\[-h\] \{([\w,-]+)\}", " ".join(plain.split()))
        groups += [(*words, name) for name in below[1].split(",")] if below else []
        read.append(" ".join(words))
    assert {"serve", "map build", "detect run", "labels restore"} <= set(read)


def test_a_banned_word_is_found() -> None:
    assert faults("The Verdict\non it") == [
        "...The Verdict on it...: write " + INSTEAD["verdicts?"]
    ]
    assert faults("mended_runs")
    assert not faults("anything amended, share_sure_and_wrong")


@pytest.mark.parametrize("name", KEPT)
def test_kept_names_are_in_use(name: str) -> None:
    texts = [prose_of(page) for page in pages()] + [path.read_text() for path in sources(".py")]
    assert any(name in text for text in texts)


def sources(*suffixes: str) -> list[Path]:
    every = (path for package in PACKAGES for path in (REPOSITORY / package).rglob("*"))
    return sorted(path for path in every if path.suffix in suffixes)


def public_names(path: Path) -> Iterator[str]:
    """Packages, module, and the public classes, functions and methods of one file."""
    yield from path.relative_to(REPOSITORY).with_suffix("").parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name


def test_public_names() -> None:
    wrong = set()
    for path in sources(".py"):
        for name in public_names(path):
            words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", " ", name)
            if not name.startswith("_"):
                wrong |= {f"{path.name}: {name}: {fault}" for fault in faults(words)}
    assert not wrong, "\n".join(sorted(wrong))


def test_page_texts() -> None:
    """What people read in the pages: HTML outside of tags, and strings with a space in HTML and
    JavaScript. Without a space a string is a key, an id or a class."""
    wrong = []
    for path in sources(".html", ".js"):
        source = re.sub(r"^\s*(//|\*|/\*).*$", "", path.read_text(), flags=re.MULTILINE)
        strings = re.findall(r"\"([^\"\n]*)\"|`([^`]*)`", source)
        texts = [re.sub(r"\$\{[^}]*\}", "", "".join(pair)) for pair in strings]
        read = [text for text in texts if " " in text]
        if path.suffix == ".html":
            read.append(re.sub(r"<[^>]*>", " ", source))
        wrong += [f"{path.name}: {fault}" for text in read for fault in faults(text)]
    assert not wrong, "\n".join(wrong)


def test_messages() -> None:
    """Texts in Python that people read, on the pages too: strings with a space or a capital first
    letter, but for docstrings and SQL."""
    wrong = []
    for path in sources(".py"):
        tree = ast.parse(path.read_text())
        docstrings = {
            id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)
        }  # and texts below constants
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value
                is_read = " " in text.strip() or text[:1].isupper()
                is_sql = re.match(r"\s*(SELECT|INSERT|UPDATE|DELETE|CREATE|ALTER|DROP)\b", text)
                if id(node) not in docstrings and is_read and not is_sql:
                    wrong += [f"{path.name}:{node.lineno}: {fault}" for fault in faults(text)]
    assert not wrong, "\n".join(wrong)

"""Writes the reference part of architecture.md from the docstrings of packages and modules.

    python docs/make_architecture.py

Everything below the heading REFERENCE is replaced; the text above it is written by hand.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "architecture.md"
REFERENCE = "## Packages and modules\n"
INTRODUCTION = """
Packages are in the order of dependencies, each before its subpackages. The text is collected
from the docstrings by `python docs/make_architecture.py`.
"""
CORE, ANNOTATION, APP = (
    REPOSITORY / root for root in ("core/semviz_core", "annotation/semviz_annotation", "semviz")
)
ORDER = {
    CORE: (
        "common", "base", "subpixel", "datasets", "pose_checks", "metrics", "detection",
        "localization", "map_tiles", "tracking", "diagnosis", "localizability", "simulation",
        "research",
    ),
    ANNOTATION: ("labels", "storage", "mapping", "assist", "label_formats", "map_formats"),
    APP: (
        "presentation", "runs", "web", "workspace", "reports", "collection",
        "batch", "what_if", "annotator", "inspector", "research", "commands",
    ),
}  # fmt: skip
RESEARCH = ("evaluation", "training", "paper", "pair_matcher")
"""In the order of dependencies; other subpackages are independent of each other."""


def docstring(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return text.replace("``", "`")


def summary(path: Path) -> str:
    """The first line of a module's docstring, as the cell of a table."""
    return docstring(path).partition("\n")[0].replace("|", "\\|")


def packages(folder: Path) -> Iterator[Path]:
    """The package and those below it."""
    yield folder
    below = {path.parent for path in folder.glob("*/__init__.py")}
    rank = {name: place for place, name in enumerate(RESEARCH)}
    for one in sorted(below, key=lambda path: (rank.get(path.name, len(rank)), path.name)):
        yield from packages(one)


def section(folder: Path) -> str:
    name = folder.relative_to(REPOSITORY).as_posix().removeprefix("core/")
    text = f"### {name.removeprefix('annotation/')}\n\n{docstring(folder / '__init__.py')}\n"
    modules = sorted(path for path in folder.glob("*.py") if path.stem != "__init__")
    rows = "".join(f"| `{path.stem}` | {summary(path)} |\n" for path in modules)
    return f"{text}\n| module | purpose |\n|---|---|\n{rows}" if rows else text


def reference() -> str:
    """Everything below the heading. Raises ValueError if a package has no place in ORDER."""
    sections = []
    for root, names in ORDER.items():
        there = {path.parent.name for path in root.glob("*/__init__.py")}
        if there != set(names):
            raise ValueError(f"{root.name}: not both in ORDER and a package: {there ^ set(names)}")
        sections.append(f"### {root.name}\n\n{docstring(root / '__init__.py')}\n")
        sections += [section(path) for name in names for path in packages(root / name)]
    command = f"`cli`: {summary(APP / 'cli.py')}\n"
    return "\n".join([INTRODUCTION, *sections, command])


def main() -> None:
    by_hand = PAGE.read_text().partition(REFERENCE)[0]
    PAGE.write_text(by_hand + REFERENCE + reference())


if __name__ == "__main__":
    main()

"""Imports run one way, and nothing heavy is imported before it is needed."""

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import semviz

REPOSITORY = Path(__file__).parents[1]
HEAVY = {"torch", "open3d", "viser", "rerun", "aiohttp", "trimesh", "pyproj"}
HEAVY |= {"lanelet2", "onnxruntime", "transformers"}  # extras
IMPORT_ALL = """
import importlib, pkgutil
package = importlib.import_module("{}")
for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
    if not module.name.startswith(("semviz_core.research.", "semviz_core.detection.network")):
        importlib.import_module(module.name)
"""


def imported_by(statement: str, folder: Path) -> set[str]:
    """Top-level modules that a fresh interpreter holds after ``statement``."""
    code = f"{statement}\nimport sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_import_contracts_hold() -> None:
    script = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run(
        [script, "--no-cache"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("statement", ["import semviz", "import semviz.cli"])
def test_the_door_to_everything_is_light(statement: str, tmp_path: Path) -> None:
    imported = imported_by(statement, tmp_path)
    assert "semviz" in imported
    assert not imported & (HEAVY | {"numpy", "scipy", "cv2", "pyarrow", "pydantic"})


@pytest.mark.parametrize("package", ["semviz_core", "semviz_annotation"])
def test_what_computes_loads_nothing_heavy_until_it_computes(package: str, tmp_path: Path) -> None:
    imported = imported_by(IMPORT_ALL.format(package), tmp_path)
    assert "numpy" in imported
    assert not imported & HEAVY


def test_architecture_page_has_the_docstrings_of_all_packages_and_modules() -> None:
    writer = runpy.run_path(str(REPOSITORY / "docs" / "make_architecture.py"))
    _, heading, reference = writer["PAGE"].read_text().partition(writer["REFERENCE"])
    assert heading
    assert reference == writer["reference"](), "run: python docs/make_architecture.py"


@pytest.mark.parametrize("root", ["core/semviz_core", "annotation/semviz_annotation", "semviz"])
def test_architecture_names_every_module(root: str) -> None:
    text = (REPOSITORY / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`(\w+)`", text))
    modules = {path.stem for path in (REPOSITORY / root).rglob("[a-z]*.py")}
    assert modules
    assert modules <= named


def product_files() -> list[Path]:
    roots = ("core/semviz_core", "annotation/semviz_annotation", "semviz")
    return sorted(path for root in roots for path in (REPOSITORY / root).rglob("*.py"))


def test_no_two_public_classes_share_a_name() -> None:
    where: dict[str, list[str]] = {}
    for path in product_files():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where.setdefault(node.name, []).append(str(path.relative_to(REPOSITORY)))
    assert "Pose" in where
    assert not {name: paths for name, paths in where.items() if len(paths) > 1}


def test_no_file_is_longer_than_a_reader_holds_in_mind() -> None:
    lengths = {path: len(path.read_text().splitlines()) for path in product_files()}
    assert len(lengths) > 100
    assert not {str(path): length for path, length in lengths.items() if length > 450}


def test_public_names_are_the_same_at_run_time_and_for_type_checkers() -> None:
    tree = ast.parse((REPOSITORY / "semviz" / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    for_checkers = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert for_checkers == semviz._HOMES
    assert set(semviz.__all__) == {*semviz._HOMES, "__version__"}
    assert set(dir(semviz)) == set(semviz.__all__)


@pytest.mark.parametrize("name", semviz.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(semviz, name) is not None


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'semviz' has no attribute 'nothing'"):
        _ = semviz.nothing

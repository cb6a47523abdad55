"""What a stranger expects of a command and a package: version, module, notebook, documentation."""

import json
import re
import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from command_line import call
from small_runs import FRAMES, saved, small_run, spoiled, unanswered

from semviz.runs.run import Run

REPOSITORY = Path(__file__).parents[2]


def test_the_version_and_the_module(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, "--version") == (0, f"semviz {version('semviz')}\n", "")
    done = subprocess.run(
        [sys.executable, "-m", "semviz", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"semviz {version('semviz')}\n"


def test_the_citation_has_the_version_of_the_package() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    citation = (REPOSITORY / "CITATION.cff").read_text()
    assert f"version: {project['version']}\n" in citation
    assert f"license: {project['license']}\n" in citation


def picture_of(html: str) -> ElementTree.Element:
    svg = re.search(r"<svg.*</svg>", html, re.DOTALL)
    assert svg is not None
    return ElementTree.fromstring(svg[0])


def test_runs_maps_and_localizations_are_pictures_in_a_notebook() -> None:
    run: Run = small_run()
    for html, circles in (
        (run._repr_html_(), len(run.semantic_map) + len(run.frames) - 1),
        (run.semantic_map._repr_html_(), len(run.semantic_map)),
    ):
        assert len(picture_of(html).findall(".//circle")) >= circles
    result = run.frames[0].localization
    picture = picture_of(result._repr_html_())
    assert len(picture.findall("line")) >= int(result.observed.is_line.sum())
    assert result.reason in result._repr_html_()


def test_the_notebook_runs_and_holds_its_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its cells, as they are shipped, show today what the file shows of them."""
    notebook = json.loads((REPOSITORY / "docs" / "examples" / "look.ipynb").read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    shown = [set(cell["outputs"][0]["data"]) for cell in code]
    assert sum("text/html" in data for data in shown) >= 3
    run = spoiled(small_run(), {FRAMES[2]: unanswered})
    monkeypatch.chdir(saved(run, tmp_path / "search.rrd").parent)
    outputs_of = runpy.run_path(str(REPOSITORY / "docs" / "make_notebook.py"))["outputs_of"]
    names: dict[str, Any] = {}
    made = [outputs_of("".join(cell["source"]), names)[0]["data"] for cell in code]
    assert [set(data) for data in made] == shown


def test_every_page_is_in_the_site_and_every_public_name_in_the_reference() -> None:
    import semviz

    site = (REPOSITORY / "mkdocs.yml").read_text()
    for page in (REPOSITORY / "docs").glob("*.md"):
        assert page.name in site, f"{page.name} is not in the navigation of mkdocs.yml"
    reference = (REPOSITORY / "docs" / "api.md").read_text()
    known = set(re.findall(r"^::: [\w.]+\.(\w+)$", reference, re.MULTILINE))
    assert set(semviz.__all__) - known == {"__version__", "DEFAULT_CLASSES"}


def test_the_ros_node_is_python() -> None:
    compile((REPOSITORY / "docs" / "examples" / "ros2_node.py").read_text(), "ros2_node.py", "exec")

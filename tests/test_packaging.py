"""The wheel holds all of the three packages and nothing else, and works in a fresh environment."""

import subprocess
import sys
import sysconfig
import urllib.request
import venv
import zipfile
from pathlib import Path

import pytest
from serving import serving

REPOSITORY = Path(__file__).parents[1]
ROOTS = {
    "semviz": REPOSITORY / "semviz",
    "semviz_core": REPOSITORY / "core" / "semviz_core",
    "semviz_annotation": REPOSITORY / "annotation" / "semviz_annotation",
}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    run(
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        folder,
        cwd=REPOSITORY,
    )
    (built,) = folder.glob("semviz-*.whl")
    return built


@pytest.fixture(scope="module")
def scripts(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scripts of a fresh environment with the wheel.

    The dependencies are those of the environment that runs the tests: it is put at the END of the
    fresh one's path, so that nothing has to be downloaded and semviz itself comes from the wheel.
    """
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, with_pip=False)
    paths = {"base": str(folder), "platbase": str(folder)}
    site_packages = Path(sysconfig.get_path("purelib", "venv", paths))
    fresh_scripts = Path(sysconfig.get_path("scripts", "venv", paths))
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = fresh_scripts / "python"
    install = ("install", "--no-deps", "--no-index", "--ignore-installed", wheel)
    run(sys.executable, "-m", "pip", "--python", python, *install, cwd=folder)
    return fresh_scripts


def test_the_wheel_holds_the_three_packages_and_nothing_else(wheel: Path) -> None:
    """Modules, py.typed, and what the pages need: html, css, js."""
    expected = {
        f"{name}/{path.relative_to(root).as_posix()}"
        for name, root in ROOTS.items()
        for path in root.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == expected
    assert {f"{name}/py.typed" for name in ROOTS} <= packed


def test_the_wheel_carries_licence_and_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" in name]
        texts = {name.split("/", 1)[1]: archive.read(name).decode() for name in names}
    assert "Apache License" in texts["licenses/LICENSE"]
    assert "semviz = semviz.cli:main" in texts["entry_points.txt"]


def test_a_fresh_environment_answers_help(scripts: Path, tmp_path: Path) -> None:
    where = run(scripts / "python", "-c", "import semviz; print(semviz.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(scripts.parent)
    text = run(scripts / "semviz", "--help", cwd=tmp_path)
    for command in ("serve", "annotate", "new", "localize", "evaluate"):
        assert command in text


def test_a_fresh_environment_has_the_whole_public_api(scripts: Path, tmp_path: Path) -> None:
    every_name = "import semviz; print(*(getattr(semviz, name) for name in semviz.__all__))"
    assert "Localizer" in run(scripts / "python", "-c", every_name, cwd=tmp_path)


@pytest.mark.timeout(400)  # the first to ask for the demo waits until it is made
def test_a_fresh_environment_serves_the_demo(
    scripts: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    with serving([scripts / "semviz", "serve"], environment, tmp_path) as address:
        for path in ("", "static/base.css", "page/main.js"):
            with urllib.request.urlopen(f"{address}{path}", timeout=30) as answer:
                assert answer.status == 200
                assert len(answer.read()) > 500


def test_bad_input_ends_with_one_line_and_status_2(scripts: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [scripts / "semviz", "localize", "nowhere"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "nowhere: no such workspace" in done.stderr

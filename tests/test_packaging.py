"""The wheel holds all of the three packages and nothing else, and works in a fresh environment.

The fresh environment has none of the extras: what people do without them works there.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from email import message_from_string
from importlib import metadata
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name
from serving import at, fetch, serving

REPOSITORY = Path(__file__).parents[1]
ROOTS = {
    "semviz": REPOSITORY / "semviz",
    "semviz_core": REPOSITORY / "core" / "semviz_core",
    "semviz_annotation": REPOSITORY / "annotation" / "semviz_annotation",
}
EXTRAS = (
    "torch",
    "open3d",
    "onnxruntime",
    "transformers",
    "lanelet2",
    "pycolmap",
    "rosbags",
    "ray",
    "s3fs",
)
"""Libraries that are imported only where somebody asked for what needs them."""
WITHOUT_EXTRAS = f"""
from importlib.machinery import PathFinder

find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *more: None if name in {EXTRAS} else find_spec(name, *more)
"""
IMPORT_ALL = """
import importlib, pkgutil, sys
failed = []
for name in ("semviz", "semviz_core", "semviz_annotation"):
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, name + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            failed.append(f"{module.name}: {error.name}")
print(*failed, sep="\\n")
assert "poselib" not in sys.modules
"""


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
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
    The extras among them are hidden.
    """
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, with_pip=False)
    paths = {"base": str(folder), "platbase": str(folder)}
    site_packages = Path(sysconfig.get_path("purelib", "venv", paths))
    fresh_scripts = Path(sysconfig.get_path("scripts", "venv", paths))
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    # Not sitecustomize: Debian's Python has one of its own, which would come first.
    (site_packages / "without_extras.py").write_text(WITHOUT_EXTRAS)
    (site_packages / "without_extras.pth").write_text("import without_extras\n")
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


def test_the_wheel_carries_a_bill_of_materials(wheel: Path) -> None:
    """What it declares, and each file of weights that it holds, with its hash."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (path,) = (name for name in names if name.endswith(".dist-info/sboms/semviz.cdx.json"))
        bill = json.loads(archive.read(path))
        hashes = {
            Path(name).stem: hashlib.sha256(archive.read(name)).hexdigest()
            for name in names
            if name.endswith(".safetensors")
        }
        (name,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        wanted = message_from_string(archive.read(name).decode()).get_all("Requires-Dist", [])
    listed = bill["components"]
    libraries = {each["name"]: each for each in listed if each["type"] == "library"}
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    needed = {canonicalize_name(re.split(r"[\s<>=!;\[]", line)[0]) for line in wanted} - {"semviz"}
    assert set(libraries) == needed
    assert libraries["numpy"]["scope"] == "required"
    assert libraries["torch"]["scope"] == "optional"
    assert bill["dependencies"][0]["dependsOn"] == [f"pkg:pypi/{name}" for name in sorted(needed)]
    weights = [each for each in listed if each["type"] == "machine-learning-model"]
    assert {each["name"]: each["hashes"][0]["content"] for each in weights} == hashes


def test_bills_of_materials_follow_the_schema(wheel: Path, tmp_path: Path) -> None:
    """That of the wheel, and that of an installation."""
    schema = pytest.importorskip("cyclonedx.schema")
    validation = pytest.importorskip("cyclonedx.validation.json")
    validator = validation.JsonStrictValidator(schema.SchemaVersion.V1_6)
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".cdx.json"))
        built = archive.read(name).decode()
    run(sys.executable, REPOSITORY / "bench" / "sbom.py", tmp_path / "sbom.json", cwd=REPOSITORY)
    for text in (built, (tmp_path / "sbom.json").read_text("utf-8")):
        assert validator.validate_str(text) is None
        wrong = text.replace('"required"', '"needed"').replace('"library"', '"book"')
        assert validator.validate_str(wrong) is not None


def test_what_only_some_need_is_in_the_extras(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = message_from_string(archive.read(name).decode())
    wanted = metadata.get_all("Requires-Dist", [])
    plain = {
        re.split(r"[\s<>=!;\[]", requirement)[0]
        for requirement in wanted
        if "extra ==" not in requirement
    }
    assert "numpy" in plain
    assert not plain & set(EXTRAS)
    names = {"all", "detect", "lanelet2", "onnx", "peers", "ros", "train", "transformers", "view3d"}
    assert names <= set(metadata.get_all("Provides-Extra", []))


def test_without_extras_all_is_imported_but_what_trains_networks(
    scripts: Path, tmp_path: Path
) -> None:
    failed = run(scripts / "python", "-c", IMPORT_ALL, cwd=tmp_path).split("\n")[:-1]
    assert failed
    assert {line.partition(": ")[2] for line in failed} == {"torch"}
    modules = {line.partition(": ")[0] for line in failed}
    networks = (
        "semviz_core.research.",
        "semviz_core.detection.network",
        "semviz.research.training_run",
    )
    assert all(module.startswith(networks) for module in modules)
    paper = "semviz_core.research.paper"
    assert not modules & {f"{paper}.method", f"{paper}.matcher"}


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
            assert len(fetch(at(address, path))) > 500


def test_bad_input_ends_with_one_line_and_status_2(scripts: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [scripts / "semviz", "localize", "nowhere"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "nowhere: no such workspace" in done.stderr


@pytest.mark.timeout(400)
def test_labels_become_a_map_and_frames_are_localized_without_extras(
    scripts: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    """Every kind of method: those that learned something compute with numpy."""
    make = "from semviz.workspace.demo import ensure_demo; print(ensure_demo())"
    demo = run(scripts / "python", "-c", make, cwd=tmp_path, env=environment).strip()
    shutil.copytree(demo, tmp_path / "demo")
    for name, method in (("ours", "joint"), ("theirs", "paper")):
        command = ("map", "build", "demo", "--name", name, "--method", method)
        assert "elements" in run(scripts / "semviz", *command, cwd=tmp_path)
    for method in ("search", "learned", "correspondences", "paper"):
        command = ("localize", "demo", "--map", "ours", "--method", method, "--frames", "0:2")
        told = run(scripts / "semviz", *command, "--out", f"{method}.rrd", cwd=tmp_path)
        assert f"{method}.rrd" in told
    told = run(scripts / "semviz", "evaluate", "search.rrd", "paper.rrd", cwd=tmp_path)
    assert "RTE" in told


@pytest.fixture(scope="module")
def town(scripts: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a workspace, and the settings of an ONNX model."""
    folder = tmp_path_factory.mktemp("town")
    run(scripts / "semviz", "new", "town", "--simulate", "7", "--frames", "0:2", cwd=folder)
    (folder / "a.toml").write_text(
        "model = 'a.onnx'\nkind = 'segmentation'\nlabels = 2\noutputs = ['logits']\n"
        "[input]\nwidth = 64\nheight = 64\n[classes]\n1 = 'pole'\n"
    )
    return folder


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("detect town", "semviz's detector needs torch: pip install 'semviz[detect]'"),
        ("detect evaluate", "semviz's detector needs torch: pip install 'semviz[detect]'"),
        ("detect town --model hf:a/b", "hf:a/b needs transformers: pip install 'semviz[transfor"),
        ("detect town --model a.toml", "a.onnx needs onnxruntime: pip install 'semviz[onnx]'"),
        ("detect train --out new", "semviz detect train needs torch: pip install 'semviz[train]'"),
        ("train paper --out new", "semviz train needs torch: pip install 'semviz[train]'"),
        ("weights old --out new", "semviz weights needs torch: pip install 'semviz[train]'"),
        ("batch detect city", "semviz batch needs ray: pip install 'semviz[ray]'"),
        ("collection create s3://a/new", "s3://a/new needs s3fs: pip install 'semviz[cloud]'"),
        ("benchmark --methods pycolmap --out new", "pycolmap: pip install 'semviz[peers]'"),
    ],
)
def test_a_missing_extra_is_asked_for_in_one_line(
    scripts: Path, town: Path, command: str, message: str
) -> None:
    done = subprocess.run(
        [scripts / "semviz", *command.split()], cwd=town, capture_output=True, text=True
    )
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (town / "new").exists()


def test_two_builds_are_the_same_bytes(wheel: Path, tmp_path: Path) -> None:
    """Whatever the time, the umask and the order of files: hatchling sorts, and dates nothing."""
    copy = tmp_path / "elsewhere"
    shutil.copytree(REPOSITORY, copy, ignore=shutil.ignore_patterns(
        ".*cache*", "*venv", ".git", "node_modules", ".hypothesis", "__pycache__"
    ))  # fmt: skip
    if (REPOSITORY / ".gitignore").is_file():
        shutil.copy(REPOSITORY / ".gitignore", copy)
    for path in copy.rglob("*.py"):
        os.utime(path, (1_000_000_000, 1_000_000_000))
    build = ("-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path / "out")
    run(sys.executable, *build, cwd=copy)
    (again,) = (tmp_path / "out").glob("semviz-*.whl")
    assert again.name == wheel.name
    assert again.read_bytes() == wheel.read_bytes()


def test_the_bill_of_materials_lists_every_dependency(tmp_path: Path) -> None:
    written = []
    for name in ("a.json", "b.json"):
        run(sys.executable, REPOSITORY / "bench" / "sbom.py", tmp_path / name, cwd=REPOSITORY)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]
    document = json.loads(written[0])
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    names = {entry["name"]: entry["version"] for entry in document["components"]}
    for requirement in tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"][
        "dependencies"
    ]:
        name = re.split(r"[<>=]", requirement)[0]
        assert names[name] == metadata.version(name)
    references = {entry["bom-ref"] for entry in document["components"]}
    needed = {need for entry in document["dependencies"] for need in entry["dependsOn"]}
    assert needed <= references
    assert len(references) == len(document["components"])


def test_every_dependency_has_a_lower_and_an_upper_bound() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = [need for needs in project["optional-dependencies"].values() for need in needs]
    for requirement in [*project["dependencies"], *extras]:
        version = requirement.split(";")[0]
        assert version.startswith("semviz[") or "==" in version or (
            ">=" in version and "<" in version
        ), requirement  # fmt: skip

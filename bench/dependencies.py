"""Resolve the oldest and the newest allowed dependencies, and run tests with each.

    pip install uv
    python bench/dependencies.py                  # makes both environments, runs the tests
    python bench/dependencies.py oldest --tests tests/core/test_pose.py

Each environment is made in a temporary folder: the plain install and what the tests need, without
extras. A line for each says which versions were tested and how it went.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

REPOSITORY = Path(__file__).parents[1]
RESOLUTIONS = {"oldest": "lowest-direct", "newest": "highest"}
TEST_TOOLS = (
    "pytest>=8.3,<10",
    "pytest-timeout",
    "pytest-xdist",
    "hypothesis",
    "build",
    "hatchling",
)
TESTS = (
    "tests/core/test_camera.py", "tests/core/test_elements.py", "tests/core/test_kitti.py",
    "tests/core/test_map_file.py", "tests/core/test_pose.py", "tests/core/test_semantic_map.py",
    "tests/core/test_trajectory.py", "tests/core/test_validation.py",
    "tests/annotation/test_formats_round_trip.py", "tests/annotation/test_map_import.py",
    "tests/annotation/test_map_mesh.py", "tests/annotation/test_proposals.py",
    "tests/annotation/test_store.py", "tests/app/test_gateway.py", "tests/app/test_run_files.py",
    "tests/app/test_web_protocol.py",
)  # fmt: skip


COMPILING_S = "1200"
"""For one test: each environment compiles anew, on a busy machine perhaps."""


@dataclass(frozen=True)
class Options:
    which: tyro.conf.Positional[tuple[Literal["oldest", "newest"], ...]] = ("oldest", "newest")
    python: str = "3.11"
    """Version of Python."""
    tests: tuple[str, ...] = TESTS


def main(options: Options) -> int:
    return max(check(which, options) for which in options.which)


def check(which: str, options: Options) -> int:
    """Make one environment, run the tests in it, and return pytest's exit status."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wanted, python = folder / "requirements.txt", folder / "venv" / "bin" / "python"
        uv("pip", "compile", "pyproject.toml", "--resolution", RESOLUTIONS[which],
           "--python-version", options.python, "--no-annotate", "-o", wanted)  # fmt: skip
        uv("venv", folder / "venv", "--python", options.python)
        uv("pip", "install", "--python", python, "-r", wanted, *TEST_TOOLS)
        uv("pip", "install", "--python", python, "--no-deps", ".")
        done = subprocess.run(
            [
                python,
                "-m",
                "pytest",
                "-n",
                "0",
                "-q",
                "-p",
                "no:cacheprovider",
                "--timeout",
                COMPILING_S,
                *options.tests,
            ],
            cwd=REPOSITORY,
            env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
            capture_output=True,
            text=True,
        )
        lines = wanted.read_text().splitlines()
    versions = ", ".join(sorted(line for line in lines if "==" in line))
    print(f"{which}: {(done.stdout.splitlines() or ['no tests'])[-1]}\n  {versions}", flush=True)
    if done.returncode:
        print(done.stdout[-5000:], done.stderr[-2000:])
    return done.returncode


def uv(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "uv", "--quiet", *arguments], cwd=REPOSITORY, check=True)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))

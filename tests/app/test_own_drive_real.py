"""Files of real drives, which are not part of the project: SEMVIZ_DRIVES names their folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import call

REPOSITORY = Path(__file__).parents[2]
pytestmark = pytest.mark.realdata


@pytest.fixture
def drives() -> Path:
    default = REPOSITORY.parent / "shared" / "data" / "drives"
    root = Path(os.environ.get("SEMVIZ_DRIVES", default))
    if not (root / "utbm_stereo").is_dir():
        pytest.skip(f"no drive utbm_stereo in {root}; set SEMVIZ_DRIVES to its folder")
    return root


def test_four_imports_of_a_real_drive_agree_with_colmap(drives: Path) -> None:
    """With strong distortion, and pixels counted from the corner or from the first centre."""
    done = subprocess.run(
        [sys.executable, REPOSITORY / "bench" / "own_drive.py", drives / "utbm_stereo"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == [
        "camera_info, TUM", "COLMAP text", "COLMAP binary", "nerfstudio"
    ]  # fmt: skip
    assert all(float(row[2]) <= 0.45 for row in rows)
    assert all(float(row[3]) < 0.1 for row in rows)


def test_a_real_stereo_pair_of_euroc_is_rectified(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = (drives / "euroc_micro" / "mav0" / name for name in ("cam0", "cam1"))
    code, out, err = call(
        capsys, "new", tmp_path / "euroc", "--images", left / "data", "--right", right / "data",
        "--calibration", left / "sensor.yaml", "--right-calibration", right / "sensor.yaml",
        "--strict",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "2 cameras 0.110 m apart" in out
    assert "names of the images, in ns" in out


def test_phone_photos_without_calibration_are_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = drives / "lund_exif_gps" / "images"
    code, _, err = call(capsys, "new", tmp_path / "lund", "--images", images)
    assert code == 2
    assert "no calibration. A guess would be wrong; give --calibration FILE" in err
    poses = drives / "lund_exif_gps" / "gps.csv"
    code, _, err = call(capsys, "new", tmp_path / "lund", "--images", images, "--poses", poses)
    assert (code, err.count("\n")) == (2, 1)

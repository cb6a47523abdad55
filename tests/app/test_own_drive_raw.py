"""Raw images of colour sensors: found at the import, and read by the command that it names."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call
from drive_formats import CALIBRATION

from semviz.workspace.workspace import Workspace
from semviz_core.common.arrays import ByteImage
from semviz_core.common.limits import read_image
from semviz_core.datasets.own_drive.images.color_orders import (
    BAYER_PATTERNS,
    EXCHANGED,
    BayerPattern,
    demosaiced,
    mosaic_of,
)

SKY, LEAVES = (110, 160, 230), (70, 100, 55)


def street(seed: int, height: int = 96, width: int = 160) -> ByteImage:
    """A blue sky over green leaves, lit unevenly."""
    light = np.random.default_rng(seed).normal(1.0, 0.2, (height, width))
    image = np.full((height, width, 3), LEAVES, np.float64)
    image[: height // 2] = SKY
    return (image * cv2.GaussianBlur(light, (0, 0), 3.0)[:, :, None]).clip(0, 255).astype(np.uint8)


def raw(image: ByteImage, pattern: BayerPattern) -> ByteImage:
    """What the sensor sees of an image, as a grey one."""
    seen = np.zeros(image.shape[:2], np.uint8)
    for place, color in enumerate(pattern):
        row, column = divmod(place, 2)
        seen[row::2, column::2] = image[row::2, column::2, "rgb".index(color)]
    return np.repeat(seen[:, :, None], 3, axis=2)


@pytest.mark.parametrize("pattern", BAYER_PATTERNS)
def test_colours_come_back(pattern: BayerPattern) -> None:
    image = street(1)
    off = np.abs(demosaiced(raw(image, pattern), pattern).astype(int) - image)
    assert np.median(off) <= 1
    assert mosaic_of(raw(image, pattern)) in (pattern, EXCHANGED[pattern])


def test_what_is_grey_or_in_colour_is_not_raw() -> None:
    image = street(2)
    gray = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[:, :, None], 3, axis=2)
    noise = np.random.default_rng(3).integers(0, 255, (96, 160, 1), np.uint8).repeat(3, axis=2)
    black, small = np.zeros_like(image), gray[:20]
    assert [mosaic_of(each) for each in (image, gray, noise, black, small)] == [None] * 5


def test_real_images_are_told_from_what_their_sensor_saw(kitti_root: Path, drives: Path) -> None:
    paths = sorted(kitti_root.glob("sequences/02/image_2/*.png"))[::8]
    paths += sorted(drives.glob("*/**/*.png"))[::4] + sorted(drives.glob("*/**/*.jpg"))[::4]
    compared = 0
    for image in map(read_image, paths):
        gray = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[:, :, None], 3, axis=2)
        assert mosaic_of(gray) is None
        if np.abs(image[:, :, 0].astype(int) - image[:, :, 2]).mean() > 2.0:
            compared += 1
            assert mosaic_of(raw(image, "gbrg")) == "gbrg"
    assert compared >= 5


def test_the_import_names_the_command_that_reads_raw_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cam"
    folder.mkdir()
    for index in range(3):
        seen = raw(street(index), "grbg")[:, :, 0]
        cv2.imwrite(str(folder / f"{1700000000 + index}.png"), seen)
    calibration = tmp_path / "camera.toml"
    calibration.write_text(
        CALIBRATION.replace("[64, 48]", "[160, 96]").replace("[31.5, 23.5]", "[80, 48]")
    )
    words = ("--images", folder, "--calibration", calibration)
    status, out, errors = call(capsys, "new", tmp_path / "grey", *words)
    assert status == 0
    assert "images are raw" in errors
    assert "--colors gbrg" in errors
    status, out, errors = call(capsys, "new", tmp_path / "swapped", *words, "--colors", "gbrg")
    assert "red and blue are swapped" in errors
    assert "--colors grbg" in errors
    status, out, errors = call(capsys, "new", tmp_path / "town", *words, "--colors", "grbg")
    assert "red, blue not swapped" in out
    assert "colours" not in errors
    assert "raw images, grbg" in out
    shown = Workspace.open(tmp_path / "town").source.image(1, "left")
    assert np.median(np.abs(shown.astype(int) - street(1))) <= 1
    assert {path.name for path in folder.iterdir()} == {f"{1700000000 + k}.png" for k in range(3)}

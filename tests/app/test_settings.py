"""A wrong bit in ``semviz.toml`` is refused in one line, or changes nothing that opens images."""

import random
from pathlib import Path

import pytest
import tomli_w

from semviz.workspace.settings import (
    PLACES,
    SETTINGS,
    Settings,
    find_place,
    read_settings,
    settings_content,
)
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.validation import Calibration

SOURCES = {
    "kitti": {"root": "../kitti", "sequence": "02", "frames": {"first": 0, "end": 90, "step": 3}},
    "images": {"images": "cam0/data", "right": "cam1/data"},
    "street": {"seed": 3, "sections": [{"kind": "sparse", "length_m": 60.0}]},
}


def made(folder: Path, kind: str) -> Settings:
    calibration = Calibration("0" * 16, (640, 480), (500.0, 500.0, 320.0, 240.0, 0.0), ())
    settings = Settings(
        version=1, name="town", source={"kind": kind, **SOURCES[kind]}, calibration=calibration
    )
    (folder / SETTINGS).write_bytes(settings_content(settings, folder))
    return settings


@pytest.mark.parametrize("kind", SOURCES)
def test_no_flipped_bit_opens_other_images(tmp_path: Path, kind: str) -> None:
    """300 flips. The calibration is compared with that of the images when they are opened."""
    settings = made(tmp_path, kind)
    content = (tmp_path / SETTINGS).read_bytes()
    rng, harmless = random.Random(1), 0
    for at in rng.sample(range(8 * len(content)), 300):
        flipped = bytearray(content)
        flipped[at // 8] ^= 1 << at % 8
        (tmp_path / SETTINGS).write_bytes(flipped)
        got = read(tmp_path)
        if isinstance(got, Settings):
            harmless += 1
            assert got.model_copy(update={"calibration": settings.calibration}) == settings
        else:
            assert "\n" not in got
    assert harmless < 150


def read(folder: Path) -> Settings | str:
    """The settings, or why they are refused."""
    try:
        return read_settings(folder)
    except SemvizError as error:
        return str(error)


def test_people_may_edit_all_but_what_the_labels_belong_to(tmp_path: Path) -> None:
    settings = made(tmp_path, "kitti")
    file = tmp_path / SETTINGS
    text = file.read_text()
    file.write_text("# mine\r\n" + text.replace("false", "true").replace("\n", "\r\n"))
    assert read_settings(tmp_path) == settings.model_copy(update={"trust_poses": True})
    edited = text.replace("../kitti", "/data/kitti")
    file.write_text(edited)
    with pytest.raises(SemvizError, match="not as semviz wrote it; if you edited it, delete"):
        read_settings(tmp_path)
    file.write_text(edited.partition("\n")[2])  # as workspaces of earlier versions are, too
    assert read_settings(tmp_path).source.root == "/data/kitti"


@pytest.mark.parametrize("root", ["x" * 3000, "a\0b", "a\nb"])
def test_impossible_places_are_one_line(tmp_path: Path, root: str) -> None:
    made(tmp_path, "kitti")
    (tmp_path / PLACES).write_text(tomli_w.dumps({"root": root}))
    text = (tmp_path / SETTINGS).read_text().partition("\n")[2]
    written = tomli_w.dumps({"root": "../kitti"}).strip()
    for edited in (written, tomli_w.dumps({"root": root}).strip()):
        assert written in text
        (tmp_path / SETTINGS).write_text(text.replace(written, edited))
        with pytest.raises(SemvizError) as caught:
            find_place(tmp_path, "root", read_settings(tmp_path).source.root)
        assert len(str(caught.value).splitlines()) == 1
        assert len(str(caught.value)) < 800

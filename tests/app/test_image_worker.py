"""The cache of encoded images: the work of frames passed quickly gives way to later ones."""

import struct
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from streets import street_workspace

from semviz.annotator import server
from semviz.annotator.proposals.image_worker import CACHED_IMAGES, Images
from semviz_core.common.arrays import ByteImage

FRAMES = 4 * CACHED_IMAGES


class SlowSource:
    """A dataset whose images wait until they are released."""

    frames = tuple(SimpleNamespace(index=index) for index in range(FRAMES))
    rig = SimpleNamespace(right=None)

    def __init__(self) -> None:
        self.released = threading.Event()
        self.read: list[int] = []

    def image(self, index: int, side: str) -> ByteImage:
        self.read.append(index)
        assert self.released.wait(60)
        return np.full((4, 6, 3), index % 256, np.uint8)


@pytest.fixture
def source() -> Iterator[SlowSource]:
    slow = SlowSource()
    yield slow
    slow.released.set()


def test_images_of_frames_passed_quickly_are_never_encoded(source: SlowSource) -> None:
    images = Images(source)  # type: ignore[arg-type]
    futures = [images.shown(index, "left") for index in range(FRAMES)]
    cancelled = [future.cancelled() for future in futures]
    source.released.set()
    last = futures[-1].result(60)
    images.close()
    assert isinstance(last, bytes)
    assert last.startswith(b"\x89PNG")
    assert not any(cancelled[-CACHED_IMAGES:])
    assert sum(cancelled) >= FRAMES - CACHED_IMAGES - 4  # but for those at work already
    assert len(set(source.read)) <= CACHED_IMAGES + 4


def test_a_cancelled_image_is_encoded_when_it_is_wanted_again(source: SlowSource) -> None:
    images = Images(source)  # type: ignore[arg-type]
    futures = [images.shown(index, "left") for index in range(FRAMES)]
    first_cancelled = next(row for row, future in enumerate(futures) if future.cancelled())
    again = images.shown(first_cancelled, "left")
    source.released.set()
    assert bytes(again.result(60)).startswith(b"\x89PNG")
    images.close()


def test_a_thumbnail_does_not_wait_for_images_that_closing_cancelled(source: SlowSource) -> None:
    """The process would never end."""
    images = Images(source)  # type: ignore[arg-type]
    for index in range(CACHED_IMAGES):
        images.shown(index, "left")
    thumbnail = images.thumbnail(0)
    time.sleep(0.2)  # by then it waits for them
    images.close()
    source.released.set()
    assert thumbnail.result(30).startswith(b"\xff\xd8")


class FileSource(SlowSource):
    """A dataset of one file, whose pixels differ from what ``image`` returns."""

    map_frame = "street"
    original_path = with_frames = lambda *_: None

    def __init__(self, path: Path, size: tuple[int, int] = (6, 4)) -> None:
        super().__init__()
        self.released.set()
        self.path = path
        self.rig = SimpleNamespace(left=SimpleNamespace(width=size[0], height=size[1]), right=None)

    def image_path(self, index: int, side: str) -> Path:
        return self.path


def png_of(image: np.ndarray[Any, Any], *options: int) -> bytes:
    return bytes(cv2.imencode(".png", image, options)[1])


def with_orientation(png: bytes) -> bytes:
    """A PNG that says in EXIF that it is turned."""
    chunk = b"eXIfMM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    sealed = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return png[:33] + sealed + png[33:]


PLAIN = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
JPEG = bytes(cv2.imencode(".jpg", PLAIN)[1])


@pytest.mark.parametrize(
    "data", [png_of(PLAIN), png_of(PLAIN[..., 0]), JPEG], ids=["RGB", "grey", "JPEG"]
)
def test_a_file_that_a_browser_shows_as_it_is_is_served_as_it_is(
    tmp_path: Path, data: bytes
) -> None:
    path = tmp_path / "image"
    path.write_bytes(data)
    images = Images(FileSource(path))  # type: ignore[arg-type]
    assert images.shown(3, "left").result(60) == path
    images.close()


@pytest.mark.parametrize(
    "data",
    [
        png_of(PLAIN.astype(np.uint16) * 256),
        png_of(np.dstack([PLAIN, PLAIN[..., :1]])),  # transparent
        png_of(PLAIN[..., 0], cv2.IMWRITE_PNG_BILEVEL, 1),
        with_orientation(png_of(PLAIN)),
        png_of(PLAIN)[:-20],
        JPEG[:-2],
        png_of(PLAIN[:3]),  # of another size
        b"GIF89a",
    ],
    ids=["16 bits", "transparent", "bilevel", "turned", "cut", "cut JPEG", "small", "GIF"],
)
def test_any_other_image_is_decoded_by_semviz(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "image"
    path.write_bytes(data)
    images = Images(FileSource(path))  # type: ignore[arg-type]
    shown = images.shown(3, "left").result(60)
    images.close()
    assert isinstance(shown, bytes)
    decoded = cv2.imdecode(np.frombuffer(shown, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert (decoded == 3).all()  # what ``image`` returned


def test_the_annotator_prepares_snapping_before_the_first_click(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = threading.Event()
    monkeypatch.setattr(server, "warm_up", prepared.set)
    annotator = server.Annotator(street_workspace(tmp_path / "street", 7, 2))
    try:
        assert prepared.wait(10.0)
    finally:
        annotator.close()

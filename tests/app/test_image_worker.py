"""The cache of encoded images: the work of frames passed quickly gives way to later ones."""

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from streets import street_workspace

from semviz.annotator import server
from semviz.annotator.image_worker import CACHED_IMAGES, Images
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
    futures = [images.png(index, "left") for index in range(FRAMES)]
    cancelled = [future.cancelled() for future in futures]
    source.released.set()
    last = futures[-1].result(60)
    images.close()
    assert last.startswith(b"\x89PNG")
    assert not any(cancelled[-CACHED_IMAGES:])
    assert sum(cancelled) >= FRAMES - CACHED_IMAGES - 4  # but for those at work already
    assert len(set(source.read)) <= CACHED_IMAGES + 4


def test_a_cancelled_image_is_encoded_when_it_is_wanted_again(source: SlowSource) -> None:
    images = Images(source)  # type: ignore[arg-type]
    futures = [images.png(index, "left") for index in range(FRAMES)]
    first_cancelled = next(row for row, future in enumerate(futures) if future.cancelled())
    again = images.png(first_cancelled, "left")
    source.released.set()
    assert again.result(60).startswith(b"\x89PNG")
    images.close()


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

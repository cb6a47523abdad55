"""The images of a source, decoded and as the page gets them: each made once and kept a while."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

from semviz_core.arrays import ByteImage
from semviz_core.sources.source import Side, Source

KEPT_DECODED = 12
"""About 17 MB of KITTI's: those around the frame on screen."""
KEPT_IMAGES = 48
"""About 40 MB of KITTI's PNGs."""
KEPT_THUMBNAILS = 4000
THUMBNAIL_WIDTH_PX = 128
FAST = 1
"""PNG compression level: a third larger than level 6, five times as fast."""

Key = tuple[int, str]
T = TypeVar("T")


class Images:
    """The images of one source. Thread-safe; futures raise what the source raises."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._order = {frame.index: place for place, frame in enumerate(source.frames)}
        self._decoded: _Kept[ByteImage] = _Kept(KEPT_DECODED, workers=2)
        self._images: _Kept[bytes] = _Kept(KEPT_IMAGES, workers=2)
        self._thumbnails: _Kept[bytes] = _Kept(KEPT_THUMBNAILS, workers=1)

    def pixels(self, index: int, side: Side) -> ByteImage:
        """(height, width, 3) sRGB; raises SemvizError where the image cannot be read."""
        return self._decoded.get((index, side), lambda: self._source.image(index, side)).result()

    def png(self, index: int, side: Side) -> "Future[bytes]":
        """The image, lossless: labels are made to a tenth of a pixel."""
        return self._images.get((index, side), lambda: encode_png(self.pixels(index, side)))

    def thumbnail(self, index: int) -> "Future[bytes]":
        """The left image as a small JPEG."""
        return self._thumbnails.get((index, "thumbnail"), lambda: self._shrunk(index))

    def prefetch(self, index: int) -> None:
        """Starts on the frames after and before ``index``, in both images."""
        frames, place = self._source.frames, self._order[index]
        for near in (place + 1, place - 1):
            if 0 <= near < len(frames):
                self.png(frames[near].index, "left")
                if self._source.rig.right is not None:
                    self.png(frames[near].index, "right")

    def close(self) -> None:
        for kept in (self._images, self._thumbnails, self._decoded):
            kept.close()

    def _shrunk(self, index: int) -> bytes:
        import cv2

        wait(self._images.unfinished())  # thumbnails never hold up the frame on screen
        image = self._source.image(index, "left")  # a whole drive of them: not kept decoded
        height = round(image.shape[0] * THUMBNAIL_WIDTH_PX / image.shape[1])
        small = cv2.resize(image, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        return _encoded(".jpg", small.astype(image.dtype), cv2.IMWRITE_JPEG_QUALITY, 82)


class _Kept(Generic[T]):
    """Results of slow work, the least recently used dropped first; each is made only once."""

    def __init__(self, limit: int, workers: int) -> None:
        self._limit = limit
        self._futures: OrderedDict[Key, Future[T]] = OrderedDict()
        self._lock = threading.Lock()
        self._workers = ThreadPoolExecutor(workers, "semviz-images")

    def get(self, key: Key, make: Callable[[], T]) -> "Future[T]":
        with self._lock:
            future = self._futures.get(key)
            if future is None or (future.done() and future.exception() is not None):
                future = self._futures[key] = self._workers.submit(make)
            self._futures.move_to_end(key)
            while len(self._futures) > self._limit:
                self._futures.popitem(last=False)
            return future

    def unfinished(self) -> list["Future[T]"]:
        with self._lock:
            return [future for future in self._futures.values() if not future.done()]

    def close(self) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)


def encode_png(image: ByteImage) -> bytes:
    """PNG of an (h, w, 3) sRGB image."""
    import cv2

    return _encoded(".png", image, cv2.IMWRITE_PNG_COMPRESSION, FAST)


def _encoded(suffix: str, image: ByteImage, option: int, value: int) -> bytes:
    import cv2

    _, data = cv2.imencode(suffix, image[..., ::-1], [option, value])
    return data.tobytes()

"""Decode images, and search them in threads for proposals and snaps.

Each image is decoded once and cached for a while; so are the results. Thread-safe.
"""

import contextlib
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals.label_proposals import (
    ImageQuery,
    ImageSearchResult,
    LabelProposal,
    PropagationQuery,
    RefinementQuery,
)
from semviz_annotation.assist.detection_refinement import RawDetection, refine_detection
from semviz_annotation.assist.expected_position import matched_element, not_sure_if_cut
from semviz_annotation.assist.image_search import ReferenceView
from semviz_annotation.assist.marked_image import Mark, MarkedImage, ProposedMark
from semviz_annotation.assist.propagation import propagate
from semviz_annotation.assist.score import LabelledView, Track
from semviz_annotation.assist.snap import Snapped, snap, whole_pole
from semviz_annotation.assist.stereo_matching import find_correspondence
from semviz_annotation.labels.labels import Pixel
from semviz_core.base.classes import ClassSet, TriangleCenter
from semviz_core.base.frame import Dataset, FileDataset, Side
from semviz_core.common import limits
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError

CACHED_DECODED = 12
"""About 17 MB of KITTI's images, around the frame on screen."""
CACHED_IMAGES = 48
"""About 40 MB of KITTI's PNGs."""
CACHED_THUMBNAILS = 4000
THUMBNAIL_WIDTH_PX = 128
FAST = 1
"""PNG compression level: a third larger than level 6, five times as fast."""

_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PNG_KIND, _GREY_OR_RGB = slice(24, 26), (b"\x08\x00", b"\x08\x02")
"""Where a PNG says its bits a channel and its kind of colours (11.2.2 IHDR), 8 bits of each."""

Key = tuple[int, str]
T = TypeVar("T")


class Images:
    """The images of one dataset, cached. Thread-safe; futures raise the errors of the dataset."""

    def __init__(self, source: Dataset) -> None:
        self._source = source
        self._order = {frame.index: rank for rank, frame in enumerate(source.frames)}
        self._decoded: _FutureCache[ByteImage] = _FutureCache(CACHED_DECODED, workers=2)
        self._images: _FutureCache[Path | bytes] = _FutureCache(CACHED_IMAGES, workers=2)
        self._thumbnails: _FutureCache[bytes] = _FutureCache(CACHED_THUMBNAILS, workers=1)

    def pixels(self, index: int, side: Side) -> ByteImage:
        """Return (height, width, 3) sRGB. Raise SemvizError if the image cannot be read."""
        return self._decoded.get((index, side), lambda: self._source.image(index, side)).result()

    def shown(self, index: int, side: Side) -> "Future[Path | bytes]":
        """Return the image for a browser: its file, if that shows the same pixels, or a PNG of it.

        Nothing is lossy: labels are made to a tenth of a pixel. It is cancelled if many others are
        wanted before its turn comes.
        """
        return self._images.get((index, side), lambda: self._shown(index, side))

    def _shown(self, index: int, side: Side) -> Path | bytes:
        path = self._plain_file(index, side)
        return encode_png(self.pixels(index, side)) if path is None else path

    def _plain_file(self, index: int, side: Side) -> Path | None:
        if not isinstance(self._source, FileDataset):
            return None
        path = self._source.image_path(index, side)
        camera = self._source.rig.left if side == "left" else self._source.rig.right
        data = limits.read_limited(path, limits.MOST_IMAGE_BYTES)
        is_plain = camera is not None and limits.image_size(data) == (camera.width, camera.height)
        return path if is_plain and _is_plain(data) else None

    def thumbnail(self, index: int) -> "Future[bytes]":
        """Return the left image as a small JPEG."""
        return self._thumbnails.get((index, "thumbnail"), lambda: self._shrink(index))

    def prefetch(self, index: int) -> None:
        """Start to prepare the images of the frames before and after ``index``."""
        frames, rank = self._source.frames, self._order[index]
        for near in (rank + 1, rank - 1):
            if 0 <= near < len(frames):
                self.shown(frames[near].index, "left")
                if self._source.rig.right is not None:
                    self.shown(frames[near].index, "right")

    def close(self) -> None:
        for cache in (self._images, self._thumbnails, self._decoded):
            cache.close()

    def _shrink(self, index: int) -> bytes:
        import cv2

        self._images.wait()  # thumbnails never delay the frame on screen
        image = self._source.image(index, "left")  # not cached decoded: there is one per frame
        height = round(image.shape[0] * THUMBNAIL_WIDTH_PX / image.shape[1])
        small = cv2.resize(image, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        return _encode(".jpg", small.astype(image.dtype), cv2.IMWRITE_JPEG_QUALITY, 82)


def _is_plain(data: bytes) -> bool:
    """Whether a browser decodes a whole JPEG, or a whole PNG of 8 bits, to the pixels of semviz.

    Not so a PNG with transparency, a palette, or an orientation of its own.
    """
    if data.startswith(_JPEG_START):
        return data.rstrip(b"\0").endswith(_JPEG_END)
    is_whole = data.startswith(_PNG_START) and data.endswith(_PNG_END)
    before_pixels = data[: data.find(b"IDAT")]
    is_opaque = data[_PNG_KIND] in _GREY_OR_RGB and b"tRNS" not in before_pixels
    return is_whole and is_opaque and b"eXIf" not in data


class _FutureCache(Generic[T]):
    """A least-recently-used cache of slow results; each is computed once.

    What leaves it before its turn is cancelled: many frames passed quickly delay no later one.
    """

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
                self._futures.popitem(last=False)[1].cancel()
            return future

    def wait(self) -> None:
        """Wait until all that is wanted now is made, failed or cancelled."""
        with self._lock:
            unfinished = [future for future in self._futures.values() if not future.done()]
        for future in unfinished:  # futures.wait() never hears of those that a shutdown cancels
            with contextlib.suppress(CancelledError):
                future.exception()

    def close(self) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)


def encode_png(image: ByteImage) -> bytes:
    """Return an (h, w, 3) sRGB image as PNG."""
    import cv2

    return _encode(".png", image, cv2.IMWRITE_PNG_COMPRESSION, FAST)


def _encode(suffix: str, image: ByteImage, option: int, value: int) -> bytes:
    import cv2

    _, data = cv2.imencode(suffix, image[..., ::-1], [option, value])
    return data.tobytes()


CACHED_RESULTS = 5000
CACHED_MARKED_IMAGES = 24
"""About 46 MB of KITTI's: a dozen moments, as tracks are searched with the views before."""

K = TypeVar("K")
V = TypeVar("V")

_NOT_FOUND = ImageSearchResult(None)


class ImageWorker:
    """Searches images and caches the results. Thread-safe."""

    def __init__(
        self,
        images: Images,
        cameras: Cameras,
        classes: Callable[[], ClassSet],
        triangle_center: TriangleCenter,
    ) -> None:
        """Marks of triangular signs follow ``triangle_center``."""
        self._images = images
        self._triangle_center: TriangleCenter = triangle_center
        self._cameras = cameras
        self._classes = classes
        self._results: _Recent[ImageQuery, Mapping[Pane, ImageSearchResult]] = _Recent(
            CACHED_RESULTS
        )
        self._marked_images: _Recent[Pane, MarkedImage] = _Recent(CACHED_MARKED_IMAGES)

    def with_results(self, candidates: Iterable[LabelProposal]) -> list[LabelProposal]:
        """Return the proposals with the results of their queries so far, without those that have no
        mark."""
        searched = [self._with_result(proposal) for proposal in candidates]
        return [proposal for proposal in searched if proposal.mark is not None]

    def pending(self, candidates: Iterable[LabelProposal]) -> list[ImageQuery]:
        """Return the queries that have no result yet."""
        queries = dict.fromkeys(
            proposal.query for proposal in candidates if proposal.query is not None
        )
        return [query for query in queries if self._results.get(query) is None]

    def search(self, query: ImageQuery) -> None:
        """Process a query; takes some milliseconds. An unreadable image has no results.

        Nor has a query that fails: the page would wait for it, without any other proposal.
        """
        results: Mapping[Pane, ImageSearchResult] = {}
        try:
            results = self._search(query)
        except SemvizError:  # the page shows the error in place of the image
            pass
        except Exception:
            logging.getLogger(__name__).exception("an image search failed")
        self._results.put(query, results)

    def best(self, query: ImageQuery, pane: Pane) -> ProposedMark | None:
        """Return the best mark in an image; processes the query first if needed."""
        if self._results.get(query) is None:
            self.search(query)
        return (self._results.get(query) or {}).get(pane, _NOT_FOUND).best

    def snap(self, pane: Pane, mark: Mark, class_id: int) -> Snapped | None:
        """Return ``mark`` snapped to image edges; None if no edge is clear."""
        try:
            return snap(self._marked_image(pane), mark, self._classes()[class_id])
        except SemvizError:
            return None

    def whole_pole(self, pane: Pane, point_px: Pixel, class_id: int) -> Mark | None:
        """Return the whole pole under a point; None if none is clear, or the class has signs."""
        class_ = self._classes()[class_id]
        if class_.kind != "line":
            return None
        try:
            return whole_pole(self._marked_image(pane), np.array(point_px), class_)
        except SemvizError:
            return None

    def _with_result(self, proposal: LabelProposal) -> LabelProposal:
        results = None if proposal.query is None else self._results.get(proposal.query)
        if results is None:
            return proposal
        return proposal.with_result(results.get(proposal.pane, _NOT_FOUND))

    def _search(self, query: ImageQuery) -> dict[Pane, ImageSearchResult]:
        """The results of a query, by image."""
        if isinstance(query, PropagationQuery):
            return self._propagate(query)
        if isinstance(query, RefinementQuery):
            return self._refine(query)
        class_ = self._classes()[query.class_id]
        there, here = self._marked_image(query.there), self._marked_image(query.here)
        matches = find_correspondence(here, there, query.mark, class_, query.element)
        if matches is None:
            return {}
        element = query.element or matched_element(here.view, query.mark, there.view, matches.best)
        best = not_sure_if_cut(matches.best, element, there.view, (here, query.mark), class_)
        return {query.there: ImageSearchResult(best, matches.runner_up)}

    def _propagate(self, query: PropagationQuery) -> dict[Pane, ImageSearchResult]:
        views = [
            ReferenceView(
                self._marked_image(image.there), self._marked_image(image.here), image.mark
            )
            for image in query.images
        ]
        beside = tuple(
            LabelledView(self._marked_image(image.pane), image.mark) for image in query.beside
        )
        track = Track(beside, query.growth)
        class_ = self._classes()[query.class_id]
        marks = propagate(views, query.element, class_, track=track)
        return {
            image.there: ImageSearchResult(
                not_sure_if_cut(
                    mark, query.element, view.target.view, (view.source, view.marked), class_
                )
            )
            for image, mark, view in zip(query.images, marks, views, strict=True)
        }

    def _refine(self, query: RefinementQuery) -> dict[Pane, ImageSearchResult]:
        detections = [
            RawDetection(
                self._marked_image(detected.pane),
                detected.mark,
                detected.score,
                detected.sigma_px,
                detected.sigma_along_px,
            )
            for detected in query.detections
        ]
        other = None if query.other is None else self._marked_image(query.other)
        panes = (*(detected.pane for detected in query.detections), query.other)
        refined = refine_detection(detections, other, self._classes()[query.class_id])
        return {
            pane: ImageSearchResult(mark, depth_m=refined.depth_m)
            for pane, mark in zip(panes, refined.proposed, strict=False)
            if pane
        }

    def _marked_image(self, pane: Pane) -> MarkedImage:
        image = self._marked_images.get(pane)
        if image is None:
            pixels = self._images.pixels(pane.frame_index, pane.side)
            view = self._cameras.view(pane.frame_index, pane.side)
            image = MarkedImage.of(view, pixels, self._triangle_center)
            self._marked_images.put(pane, image)
        return image


class _Recent(Generic[K, V]):
    """A cache of the most recently stored values. Thread-safe."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K) -> V | None:
        with self._lock:
            return self._values.get(key)

    def put(self, key: K, value: V) -> None:
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._limit:
                self._values.popitem(last=False)

"""Regions on rendered streets: with the errors of a network, or from a network."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.detection.detector import RegionModel
from semviz_core.detection.regions import Region
from semviz_core.metrics.detection import ImageGroundTruth, match_detections
from semviz_core.simulation.detector import RenderedTruth, rendered_truth
from semviz_core.simulation.street import Street
from semviz_core.subpixel.sampling import SampledImage

FRAMES = (5, 20, 35, 50)
_MODEL_SIGMA_PX = 0.8


@dataclass(frozen=True, eq=False)
class Shown:
    """One image, and what is truly to be seen in it."""

    picture: SampledImage
    truth: ImageGroundTruth
    whole: RenderedTruth
    seed: int


def shown(seeds: Iterable[int]) -> Iterator[Shown]:
    """The left images of some frames of each street."""
    for seed in seeds:
        street = Street(seed, triangle_center="box")
        for index in FRAMES:
            whole = rendered_truth(street, index, "left")
            elements = street.truth_map.elements
            rows = np.searchsorted(elements.id, whole.element_id)
            away = elements.anchor_m[rows] - street.view(index, "left").center_m
            truth = ImageGroundTruth.of(whole.elements, np.linalg.norm(away[:, :2], axis=1))
            yield Shown(SampledImage(street.image(index, "left")), truth, whole, seed)


def planted(shown: Shown) -> tuple[list[Region], IntArray]:
    """What counts in an image as regions that are off as a network's, and whose they are."""
    rng = np.random.default_rng([shown.seed, len(shown.whole.regions)])
    rows = np.flatnonzero(shown.truth.counts)
    size = (shown.picture.image.shape[0], shown.picture.image.shape[1])
    return [as_found(shown.whole.regions[row], size, rng) for row in rows], rows


def found(shown: Shown, model: RegionModel) -> tuple[list[Region], IntArray]:
    """A model's own regions of what counts in an image, and whose they are."""
    regions = list(model.find(shown.picture.image))
    rows = match_detections(_as_elements(regions), shown.truth)
    return [regions[k] for k in np.flatnonzero(rows >= 0)], rows[rows >= 0]


def _as_elements(regions: list[Region]) -> Elements2D:
    """Regions as the model tells them."""
    ends = np.full((len(regions), 2, 2), np.nan)
    for row, region in enumerate(regions):
        ends[row, 0] = region.center_px
        if region.class_id == POLE:
            left, top, right, bottom = region.box_px
            middle = (left + right) / 2.0
            box = np.array([[middle, top], [middle, bottom]])
            ends[row] = box if region.ends_px is None else region.ends_px
    classes = [-1 if region.class_id is None else region.class_id for region in regions]
    return Elements2D.from_ends(ends[:, 0], ends[:, 1], classes)


def as_found(region: Region, size: tuple[int, int], rng: np.random.Generator) -> Region:
    """A true region in an image of a size (height, width), off as networks' are: ends and boxes
    by some px, masks grown, shrunk, coarse or with holes; some without ends, mask or class."""
    ends, known = None, None
    if region.ends_px is not None and rng.random() < 0.7:
        ends, known = _ends(region, rng)
    mask = _mask(region, size, rng)
    box, corner = region.box_px, (0, 0)
    if mask.any():
        rows, columns = np.nonzero(mask)
        corner = (int(columns.min()), int(rows.min()))
        mask = mask[corner[1] : rows.max() + 1, corner[0] : columns.max() + 1]
        box = np.array([*corner, columns.max(), rows.max()], dtype=np.float64)
    box = box + np.clip(rng.normal(0.0, 1.5, 4), -4.0, 4.0)
    box = np.concatenate([np.minimum(box[:2], box[2:]), np.maximum(box[:2], box[2:])])
    masked = bool(mask.any() and rng.random() < 0.7)
    class_id = None if region.class_id != POLE and rng.random() < 0.3 else region.class_id
    return Region(
        class_id=class_id,
        score=float(rng.uniform(0.3, 1.0)),
        box_px=box,
        mask=mask if masked else None,
        corner_px=corner if masked else (0, 0),
        ends_px=ends,
        ends_known=known,
    )


def _ends(region: Region, rng: np.random.Generator) -> tuple[FloatArray, tuple[bool, bool]]:
    """Off by little across; along by more, and some by a share of the length."""
    ends, known = region.ends_px, region.ends_known
    assert ends is not None
    assert known is not None
    length = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / length
    normal = np.array([along[1], -along[0]])
    slid = rng.normal(0.0, 1.5 + 0.02 * length, 2)
    wrong = rng.uniform(-0.15, 0.3, 2) * length * [1.0, -1.0]
    slid = np.where(rng.random(2) < 0.1, wrong, slid)
    slid = np.clip(slid, -0.35 * length, 0.35 * length)
    off = np.clip(rng.normal(0.0, _MODEL_SIGMA_PX, 2), -4.0, 4.0)
    told = np.array(known) ^ (rng.random(2) < 0.08)
    return ends + slid[:, None] * along + off[:, None] * normal, (bool(told[0]), bool(told[1]))


def _mask(region: Region, size: tuple[int, int], rng: np.random.Generator) -> BoolArray:
    """(height, width) of the whole image."""
    assert region.mask is not None
    mask: NDArray[np.uint8] = np.zeros(size, np.uint8)
    (left, top), (height, width) = region.corner_px, region.mask.shape
    mask[top : top + height, left : left + width] = region.mask
    grown = int(rng.integers(-1, 3))
    kernel = np.ones((2 * abs(grown) + 1,) * 2, np.uint8)
    if grown > 0 or min(height, width) > 6:
        mask = np.asarray((cv2.dilate if grown > 0 else cv2.erode)(mask, kernel), np.uint8)
    if rng.random() < 0.5:
        coarse = (-(-size[1] // 4), -(-size[0] // 4))
        low = cv2.resize(mask.astype(np.float32), coarse, interpolation=cv2.INTER_AREA)
        mask = np.asarray(cv2.resize(low, size[::-1]) > 0.35, np.uint8)
    for _ in range(rng.integers(0, 3)):
        inside = np.argwhere(mask)
        if len(inside) < 20:
            break
        row, column = inside[rng.integers(len(inside))]
        half = int(rng.integers(2, 7))
        mask[max(0, row - half) : row + half, max(0, column - half) : column + half] = 0
    return mask > 0


def masked_in_part(shown: Shown) -> tuple[list[Region], IntArray]:
    """What counts in an image as a segmenter's masks, and whose they are.

    Masks are coarse or with holes, and say nothing of ends. Of most poles they end early: up to
    54 % of the upper part is missing, or 36 % of the lower part, or both.
    """
    rng = np.random.default_rng([shown.seed, len(shown.whole.regions), 1])
    size = (shown.picture.image.shape[0], shown.picture.image.shape[1])
    regions, rows = [], []
    for row in np.flatnonzero(shown.truth.counts):
        region = shown.whole.regions[row]
        mask = _mask(region, size, rng)
        if region.class_id == POLE:
            low, high = region.box_px[1], region.box_px[3]
            missing = rng.uniform(0.1, 0.6, 2) * (rng.random(2) < 0.5) * (high - low) * [0.9, 0.6]
            mask[: int(low + missing[0])] = False
            mask[int(high - missing[1]) + 1 :] = False
        if mask.sum() < 16:
            continue
        at_row, at_column = np.nonzero(mask)
        left, top, right, bottom = (
            int(edge) for edge in (at_column.min(), at_row.min(), at_column.max(), at_row.max())
        )
        if region.class_id == POLE and bottom - top < 8:
            continue
        regions.append(
            Region(
                class_id=POLE if region.class_id == POLE else None,
                score=float(rng.uniform(0.3, 1.0)),
                box_px=np.array([left, top, right, bottom], np.float64),
                mask=mask[top : bottom + 1, left : right + 1],
                corner_px=(left, top),
            )
        )
        rows.append(row)
    return regions, np.array(rows, np.int64)


def overgrown(shown: Shown) -> Shown:
    """An image in which leaves hide the upper or the lower end of a third of the poles."""
    rng = np.random.default_rng([shown.seed, len(shown.whole.regions), 2])
    image = shown.picture.image.copy()
    elements = shown.whole.elements
    ends = np.stack([elements.anchor_px, elements.end_px], axis=1)
    known = np.stack([elements.anchor_known, elements.end_known], axis=1)
    regions = list(shown.whole.regions)
    chosen = elements.is_line & shown.truth.counts & (rng.random(len(ends)) < 0.33)
    for row in np.flatnonzero(chosen):
        which = int(rng.random() < 0.3)
        hidden = rng.uniform(0.15, 0.5)
        place = ends[row, which] + hidden * (ends[row, 1 - which] - ends[row, which])
        leaves = _leaves(image, ends[row, which], place, rng)
        ends[row, which], known[row, which] = place, False
        region = regions[row]
        assert region.mask is not None
        (left, top), (height, width) = region.corner_px, region.mask.shape
        seen = region.mask & ~leaves[top : top + height, left : left + width]
        if seen.any():
            told = bool(known[row, 0]), bool(known[row, 1])
            regions[row] = replace(region, mask=seen, ends_px=ends[row], ends_known=told)
    changed = replace(
        elements, anchor_px=ends[:, 0], end_px=ends[:, 1],
        anchor_known=known[:, 0], end_known=known[:, 1],
    )  # fmt: skip
    return Shown(
        SampledImage(image),
        replace(shown.truth, elements=changed),
        shown.whole._replace(elements=changed, regions=tuple(regions)),
        shown.seed,
    )


def _leaves(
    image: NDArray[np.uint8], end: FloatArray, place: FloatArray, rng: np.random.Generator
) -> BoolArray:
    """Paint leaves over a pole from an end to a place; return (height, width) where they are."""
    height, width = image.shape[:2]
    away = float(np.linalg.norm(end - place))
    middle = (end + place) / 2.0
    axes = np.array([away * rng.uniform(0.4, 1.2) + 8.0, away / 2.0])
    v, u = np.mgrid[:height, :width]
    fine, coarse = (
        2.0 * scale * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), scale)
        for scale in (rng.uniform(0.7, 2.5), 5.0)
    )
    ragged = 0.15 * coarse
    covered = ((u - middle[0]) / axes[0]) ** 2 + ((v - middle[1]) / axes[1]) ** 2 < 1.0 + ragged
    bright = rng.uniform(25.0, 110.0) * np.exp(rng.uniform(0.3, 1.0) * fine)
    color = np.array([rng.uniform(0.6, 1.1), 1.0, rng.uniform(0.3, 0.8)])
    painted = np.clip(bright[..., None] * color, 0.0, 255.0).astype(np.uint8)
    image[covered] = painted[covered]
    return np.asarray(covered)


def false_masks(shown: Shown, count: int = 10) -> list[Region]:
    """Masks of what is no sign: ragged ones anywhere, and parts of one colour, as of walls."""
    rng = np.random.default_rng([shown.seed, len(shown.whole.regions), 3])
    height, width = shown.picture.image.shape[:2]
    signs = np.zeros((height, width), bool)
    for region in shown.whole.regions:
        if region.class_id != POLE and region.mask is not None:
            (left, top), (rows, columns) = region.corner_px, region.mask.shape
            signs[top : top + rows, left : left + columns] |= region.mask
    found: list[Region] = []
    while len(found) < count:
        half = int(rng.uniform(4.0, 22.0))
        u, v = int(rng.integers(half, width - half)), int(rng.integers(half, 250 - half))
        window = np.s_[v - half : v + half, u - half : u + half]
        ragged = rng.random() < 0.6
        mask = _ragged(half, rng) if ragged else _one_color(shown.picture.image[window])
        rows_at, columns_at = np.nonzero(mask)
        if len(rows_at) < 25 or (signs[window] & mask).any():
            continue
        top, left = int(rows_at.min()), int(columns_at.min())
        bottom, right = int(rows_at.max()), int(columns_at.max())
        corner = (u - half + left, v - half + top)
        box = np.array([*corner, u - half + right, v - half + bottom], np.float64)
        if min(right - left, bottom - top) >= 5:
            shape = mask[top : bottom + 1, left : right + 1]
            found.append(Region(None, 0.5, box, shape, corner))
    return found


def _ragged(half: int, rng: np.random.Generator) -> BoolArray:
    """A blob (2 half, 2 half) with a ragged border."""
    v, u = (np.mgrid[: 2 * half, : 2 * half] - half + 0.5) / half
    noise = cv2.GaussianBlur(rng.normal(size=(2 * half, 2 * half)), (0, 0), 0.25 * half) * half
    reach = 0.7 + rng.uniform(0.1, 0.5) * noise
    return np.asarray((u / rng.uniform(0.5, 1.0)) ** 2 + (v / rng.uniform(0.5, 1.0)) ** 2 < reach)


def _one_color(window: NDArray[np.uint8]) -> BoolArray:
    """The part of a window around its middle that has the middle's colour."""
    filled = np.zeros((window.shape[0] + 2, window.shape[1] + 2), np.uint8)
    middle = (window.shape[1] // 2, window.shape[0] // 2)
    near = (14, 14, 14)
    cv2.floodFill(window.copy(), filled, middle, (0, 0, 0), near, near, 4 | cv2.FLOODFILL_MASK_ONLY)
    inside = cv2.morphologyEx(filled[1:-1, 1:-1], cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(inside > 0)

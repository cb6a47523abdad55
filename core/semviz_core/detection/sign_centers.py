"""Candidates for a sign's centre and shape: from the model's region and from its outline."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.classes import DEFAULT_CLASSES, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.detection.regions import SHAPE, Region, predicted_sigma_px, predicted_sigmas_px
from semviz_core.subpixel.sampling import SampledImage
from semviz_core.subpixel.sign_outline import Outline, fit_outlines, outline_polygon, turns_of

SHAPES = (TRIANGULAR, RECTANGULAR, ROUNDED)
"""Classified here if the model does not tell the shape."""
STRAY_PX, STRAY_SHARE = 2.6, 0.02
"""An outline further from the model's centre than this plus this share of the sign's size is
another outline: the border's inner edge, or the pictogram."""
_BODY, _WITHOUT_ARMS = 0.6, 0.9
"""Rows and columns of a mask's body have this share of the usual number of pixels; a body of more
than this share of the mask's height and width is the mask."""
_FILLED = {TRIANGULAR: 0.5, RECTANGULAR: 1.0, ROUNDED: np.pi / 4.0}
"""Share of its box that each shape covers."""


@dataclass(frozen=True, eq=False)
class SignCenter:
    """A candidate for a sign's centre."""

    kind: str
    """How it was measured: a key of ``regions.WEIGHTS``."""
    center_px: FloatArray
    """(2,) of its box."""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    """(k,) of its kind."""
    sigma_px: float
    """Sigma of one coordinate."""
    outline: Outline | None = None
    to_centroid_px: float = float("nan")
    """As in ``Elements2D``."""


def best_center(image: SampledImage, region: Region) -> tuple[int, SignCenter, float]:
    """Return a sign's class, its probability, and the centre with the least sigma.

    The probability is 1 if the model tells the class. Otherwise the image decides between the
    shapes and no sign at all.
    """
    model_center = center_by_model(region)
    if region.class_id is not None and region.class_id not in DEFAULT_CLASSES:
        return region.class_id, model_center, 1.0  # a class of unknown shape
    classes = SHAPES if region.class_id is None else (region.class_id,)
    body = without_arms(region) if region.class_id is None else []
    outlines = centers_from_outline(image, model_center, classes, body, turn_of_mask(region))
    class_id, probability = classes[0], 1.0
    if region.class_id is None:
        class_id, probability = likeliest_shape([region, *body], model_center, outlines)
    candidates = [model_center, *outlines[class_id]]
    best = min(candidates, key=lambda center: center.sigma_px)
    if class_id == TRIANGULAR and best is model_center:
        turn = turn_of_mask(region) or _turn_of_clearest(outlines[class_id])
        best = replace(best, to_centroid_px=turn * float(best.half_px[1]) / 3.0)
    return class_id, best, probability


def turn_of_mask(region: Region) -> int:
    """Return 1 if a triangle's mask is upright, -1 if upside down (give way), 0 without mask.

    An upright one is mostly above its widest row, even if the mask runs into the pole.
    """
    if region.mask is None or not region.mask.any():
        return 0
    widths = region.mask.sum(axis=1)[region.mask.any(axis=1)]
    widest = int(np.argmax(widths))
    return 1 if widths[:widest].sum() >= widths[widest + 1 :].sum() else -1


def _turn_of_clearest(outlines: Sequence[SignCenter]) -> int:
    """Return the turn of the clearest outline; upright, like most, if there is none."""
    if not outlines:
        return 1
    clearest = min(outlines, key=lambda center: center.sigma_px)
    return 1 if clearest.to_centroid_px > 0.0 else -1


def likeliest_shape(
    regions: Sequence[Region], model_center: SignCenter, outlines: dict[int, list[SignCenter]]
) -> tuple[int, float]:
    """Return the class of the likeliest shape and its probability; the rest is for no sign.

    ``regions`` are the sign's region and those of ``without_arms``.
    """
    evidence = [
        shape_evidence(regions, class_, model_center, outlines[class_]) for class_ in SHAPES
    ]
    odds = np.exp(np.clip(np.array(evidence) @ SHAPE, -30.0, 30.0))
    best = int(np.argmax(odds))
    return SHAPES[best], float(odds[best] / (1.0 + odds.sum()))


def center_by_model(region: Region) -> SignCenter:
    """Return the model's centre: of its box, or of the area of its mask."""
    candidates = [_between("center by box", region.box_px[:2], region.box_px[2:], 0.0)]
    if region.mask is not None and region.mask.any():
        rows = np.flatnonzero(region.mask.any(axis=1))
        columns = np.flatnonzero(region.mask.any(axis=0))
        low = region.corner_px + np.array([columns[0], rows[0]], dtype=np.float64)
        high = region.corner_px + np.array([columns[-1], rows[-1]], dtype=np.float64)
        assert region.filled is not None
        candidates.append(_between("center by mask", low, high, 1.0 - region.filled))
    return min(candidates, key=lambda center: center.sigma_px)


def without_arms(region: Region) -> list[Region]:
    """Return a region with the body of its mask only; empty if the mask has no arms.

    A mask often runs into the pole, the frame or a bush beside the sign.
    """
    if region.mask is None or not region.mask.any():
        return []
    first, last = [], []
    for axis in (0, 1):  # columns, rows
        counts = region.mask.sum(axis=axis)
        wide = np.flatnonzero(counts >= _BODY * _usual(counts[counts > 0]))
        first.append(int(wide[0]))
        last.append(int(wide[-1]) + 1)
    tops = {first[1], 0}  # a triangle is narrow at its top, but that is no arm
    bodies = [region.mask[top : last[1], first[0] : last[0]] for top in sorted(tops)]
    return [
        _part(region, body, (first[0], top))
        for top, body in zip(sorted(tops), bodies, strict=True)
        if min(np.divide(body.shape, region.mask.shape)) <= _WITHOUT_ARMS and body.any()
    ]


def _usual(counts: IntArray) -> float:
    """Return the 80th percentile; NumPy's own takes ten times as long."""
    last = len(counts) - 1
    return float(np.interp(0.8 * last, np.arange(last + 1), np.sort(counts)))


def _part(region: Region, mask: BoolArray, at: tuple[int, int]) -> Region:
    """Return a region with a part of its mask, which begins at a column and row of it."""
    left, top = region.corner_px[0] + at[0], region.corner_px[1] + at[1]
    box = np.array([left, top, left + mask.shape[1] - 1, top + mask.shape[0] - 1], np.float64)
    return replace(region, box_px=box, mask=mask, corner_px=(left, top))


def _between(kind: str, low_px: FloatArray, high_px: FloatArray, bare: float) -> SignCenter:
    """Return the centre between two corners; ``bare`` is the share that the mask leaves free."""
    half = np.asarray((high_px - low_px + 1.0) / 2.0)
    evidence = np.array([np.log(half.mean()), abs(np.log(half[0] / half[1])), bare])
    sigma = predicted_sigma_px(kind, evidence)
    return SignCenter(kind, np.asarray((low_px + high_px) / 2.0), half, evidence, sigma)


def centers_from_outline(
    image: SampledImage,
    model_center: SignCenter,
    classes: Sequence[int],
    body: Sequence[Region] = (),
    turn: int = 0,
) -> dict[int, list[SignCenter]]:
    """Return for each class the centres of outlines of its shape, near the model's centre.

    ``body`` are further regions near whose centres outlines may be. ``turn`` is that of a
    triangle, as in ``turn_of_mask``; 0 tries both.
    """
    shapes = [DEFAULT_CLASSES[class_].shape for class_ in classes]
    turned = [each for shape in shapes for each in turns_of(shape)]
    if turn:
        turned = [each for each in turned if each != ("triangle down" if turn > 0 else "triangle")]
    about = [(model_center.center_px, model_center.half_px, turned)]
    for each in body:
        half = np.asarray((each.box_px[2:] - each.box_px[:2] + 1.0) / 2.0)
        about.append((each.center_px, half, _turns_in(each, body, turned)))
    fitted: list[Outline] = []
    for middle, half, tried in about:
        stray_px = STRAY_PX + STRAY_SHARE * 2.0 * half.mean()
        found = fit_outlines(image, middle, half, tried)
        away = np.hypot(*(_centers_px(found) - middle).T)
        fitted += [found[row] for row in np.flatnonzero(away <= stray_px).tolist()]
    centers = {}
    for class_, shape in zip(classes, shapes, strict=True):
        alike = [outline for outline in fitted if outline.is_of(shape)]
        centers[class_] = _by_outlines(alike, model_center)
    return centers


def _turns_in(body: Region, bodies: Sequence[Region], turned: Sequence[str]) -> list[str]:
    """Return the outlines to try in a body: triangles where the top is whole, others elsewhere."""
    whole = body.box_px[1] == min(each.box_px[1] for each in bodies)
    either = len(bodies) == 1
    return [each for each in turned if either or whole == each.startswith("triangle")]


def _centers_px(outlines: Sequence[Outline]) -> FloatArray:
    return np.array([outline.center_px for outline in outlines]).reshape(-1, 2)


def _by_outlines(outlines: Sequence[Outline], model_center: SignCenter) -> list[SignCenter]:
    """Return the centres of outlines of one shape."""
    if not outlines:
        return []
    centers, score = _centers_px(outlines), np.array([outline.score for outline in outlines])
    half = np.array([outline.half_px for outline in outlines])
    grown = np.abs(np.log(half / model_center.half_px))
    moved = np.abs(centers - model_center.center_px).max(axis=1) / model_center.sigma_px
    apart = np.hypot(*(centers[:, None] - centers).T) > 1.0
    lead = np.where(apart, score[:, None] - score, np.inf).min(axis=1)
    evidence = np.column_stack(
        [
            np.array([outline.evidence[1:] for outline in outlines]),
            np.minimum(lead, 5.0), grown.mean(axis=1), grown.max(axis=1),
            np.log(moved + 0.5), np.full(len(outlines), np.log(model_center.sigma_px)),
        ]
    )  # fmt: skip
    kind = "center by outline"
    sigmas = predicted_sigmas_px(kind, evidence).tolist()
    return [
        SignCenter(kind, each.center_px, each.half_px, row, sigma, each, each.to_centroid_px)
        for each, row, sigma in zip(outlines, evidence, sigmas, strict=True)
    ]


def shape_evidence(
    regions: Sequence[Region], class_id: int, model_center: SignCenter, centers: list[SignCenter]
) -> FloatArray:
    """Return (k,) evidence for a class against no sign: the class, its outline and its mask.

    ``regions`` are the sign's region and those of ``without_arms``.
    """
    region = regions[0]
    one_hot = [float(class_id == shape) for shape in SHAPES]
    fill_error = 0.0
    if region.filled is not None:
        share = _FILLED.get(class_id, np.pi / 4.0)
        fill_error = min(abs((each.filled or 0.0) - share) for each in regions)
    size = np.log(model_center.half_px.min())
    if not centers:
        return np.array([*one_hot, 1.0, 0.0, 0.0, 1.0, 0.0, fill_error, size])
    best = min(centers, key=lambda center: center.sigma_px)
    overlap = max(_overlap(each, best) for each in regions)
    fit = [best.evidence[0], best.evidence[1], 1.0 - overlap, np.log(best.sigma_px)]
    return np.array([*one_hot, 0.0, *fit, fill_error, size])


def _overlap(region: Region, center: SignCenter) -> float:
    """Return the intersection over union of an outline and the region's mask, or its box."""
    assert center.outline is not None
    polygon_px = outline_polygon(center.outline)
    if region.mask is None or not region.mask.any():
        low, high = polygon_px.min(axis=0), polygon_px.max(axis=0)
        inner = np.minimum(high, region.box_px[2:]) - np.maximum(low, region.box_px[:2])
        common = float(np.clip(inner, 0.0, None).prod())
        both = (high - low).prod() + (region.box_px[2:] - region.box_px[:2]).prod()
        return common / max(float(both) - common, 1e-9)
    return _mask_overlap(region.mask, polygon_px - region.corner_px)


def _mask_overlap(mask: BoolArray, polygon: FloatArray) -> float:
    """Return the intersection over union of a mask and a polygon (n, 2) in its pixels."""
    import cv2

    outside = max(-polygon.min(), 0.0, *(polygon.max(axis=0) - mask.shape[::-1]))
    margin = int(min(outside, 200.0))
    canvas = np.zeros([side + 2 * margin for side in mask.shape], np.uint8)
    corners = np.round((polygon + margin) * 16.0).astype(np.int32)
    cv2.fillPoly(canvas, [corners], 1, cv2.LINE_8, 4)
    height, width = mask.shape
    inside = canvas[margin : margin + height, margin : margin + width]
    common = np.count_nonzero(inside & mask)
    return common / (np.count_nonzero(canvas) + np.count_nonzero(mask) - common)


def class_by_mask(region: Region) -> int:
    """Return the shape that covers the most similar share of its box; rectangular without mask."""
    filled = region.filled
    if filled is None:
        return RECTANGULAR
    return min(SHAPES, key=lambda class_id: abs(filled - _FILLED[class_id]))

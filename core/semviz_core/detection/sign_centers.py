"""Candidates for a sign's centre and shape: from the model's region and from its outline."""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.classes import DEFAULT_CLASSES, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import FloatArray
from semviz_core.detection.regions import SHAPE, Region, predicted_sigma_px
from semviz_core.subpixel.sampling import SampledImage
from semviz_core.subpixel.sign_outline import Outline, fit_outlines

SHAPES = (TRIANGULAR, RECTANGULAR, ROUNDED)
"""Classified here if the model does not tell the shape."""
STRAY_PX, STRAY_SHARE = 2.6, 0.02
"""An outline further from the model's centre than this plus this share of the sign's size is
another outline: the border's inner edge, or the pictogram."""
_FILLED = {TRIANGULAR: 0.5, RECTANGULAR: 1.0, ROUNDED: np.pi / 4.0}
"""Share of its box that each shape covers."""


@dataclass(frozen=True, eq=False)
class SignCenter:
    """A candidate for a sign's centre."""

    kind: str
    """How it was measured: a key of ``regions.WEIGHTS``."""
    center_px: FloatArray
    """(2,)"""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    """(k,) of its kind."""

    @property
    def sigma_px(self) -> float:
        """Sigma of one coordinate."""
        return predicted_sigma_px(self.kind, self.evidence)


def best_center(image: SampledImage, region: Region) -> tuple[int, SignCenter]:
    """Return a sign's class and the centre with the least sigma."""
    model_center = center_by_model(region)
    if region.class_id is not None and region.class_id not in DEFAULT_CLASSES:
        return region.class_id, model_center  # a class of unknown shape
    classes = SHAPES if region.class_id is None else (region.class_id,)
    outlines = {class_: centers_from_outline(image, model_center, class_) for class_ in classes}
    evidence = [
        shape_evidence(region, class_, outlines[class_] or [model_center]) @ SHAPE
        for class_ in classes
    ]
    class_id = classes[int(np.argmax(evidence))]
    return class_id, min([model_center, *outlines[class_id]], key=lambda center: center.sigma_px)


def center_by_model(region: Region) -> SignCenter:
    """Return the model's centre: of its box, or of the area of its mask."""
    candidates = [_between("center by box", region.box_px[:2], region.box_px[2:], 0.0)]
    if region.mask is not None and region.mask.any():
        rows = np.flatnonzero(region.mask.any(axis=1))
        columns = np.flatnonzero(region.mask.any(axis=0))
        low = region.corner_px + np.array([columns[0], rows[0]], dtype=np.float64)
        high = region.corner_px + np.array([columns[-1], rows[-1]], dtype=np.float64)
        candidates.append(_between("center by mask", low, high, 1.0 - _filled(region)))
    return min(candidates, key=lambda center: center.sigma_px)


def _between(kind: str, low_px: FloatArray, high_px: FloatArray, bare: float) -> SignCenter:
    """Return the centre between two corners; ``bare`` is the share that the mask leaves free."""
    half = np.asarray((high_px - low_px + 1.0) / 2.0)
    evidence = np.array([np.log(half.mean()), abs(np.log(half[0] / half[1])), bare])
    return SignCenter(kind, np.asarray((low_px + high_px) / 2.0), half, evidence)


def centers_from_outline(
    image: SampledImage, model_center: SignCenter, class_id: int
) -> list[SignCenter]:
    """Return centres of outlines of a class's shape, near the model's centre."""
    shape = DEFAULT_CLASSES[class_id].shape
    fitted = fit_outlines(image, model_center.center_px, model_center.half_px, shape)
    stray = STRAY_PX + STRAY_SHARE * 2.0 * model_center.half_px.mean()
    near = [
        outline
        for outline in fitted
        if np.linalg.norm(outline.center_px - model_center.center_px) <= stray
    ]
    return [_by_outline(outline, model_center, near) for outline in near]


def _by_outline(outline: Outline, model_center: SignCenter, outlines: list[Outline]) -> SignCenter:
    grown = np.abs(np.log(outline.half_px / model_center.half_px))
    moved = np.abs(outline.center_px - model_center.center_px).max() / model_center.sigma_px
    others = [
        outline.score - other.score
        for other in outlines
        if np.linalg.norm(other.center_px - outline.center_px) > 1.0
    ]
    evidence = np.array(
        [
            *outline.evidence[1:], min([5.0, *others]), grown.mean(), grown.max(),
            np.log(moved + 0.5), np.log(model_center.sigma_px),
        ]
    )  # fmt: skip
    return SignCenter("center by outline", outline.center_px, outline.half_px, evidence)


def shape_evidence(region: Region, class_id: int, centers: list[SignCenter]) -> FloatArray:
    """Return (k,) evidence for a class: the class, the fit of its outline, the mask's filling."""
    best = min(centers, key=lambda center: center.sigma_px)
    fill_error = 0.0
    if region.mask is not None and region.mask.any():
        fill_error = abs(_filled(region) - _FILLED.get(class_id, np.pi / 4.0))
    one_hot = np.array([class_id == shape for shape in SHAPES], dtype=np.float64)
    return np.array(
        [*one_hot, np.log(best.sigma_px), best.evidence[0], best.evidence[1], fill_error]
    )


def class_by_mask(region: Region) -> int:
    """Return the shape that covers the most similar share of its box; rectangular without mask."""
    if region.mask is None or not region.mask.any():
        return RECTANGULAR
    filled = _filled(region)
    return min(SHAPES, key=lambda class_id: abs(filled - _FILLED[class_id]))


def _filled(region: Region) -> float:
    """Return the share of its extent that a mask covers."""
    assert region.mask is not None
    rows, columns = region.mask.any(axis=1), region.mask.any(axis=0)
    return float(region.mask[rows][:, columns].mean())

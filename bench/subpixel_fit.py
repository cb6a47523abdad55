"""Fit the weights of semviz_core.detection.regions, one kind of evidence after the other."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from subpixel_regions import Shown, false_masks, masked_in_part, overgrown

from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.detection import regions as sigma
from semviz_core.detection.detector import is_pole, measure
from semviz_core.detection.pole_axes import best_line, first_lines, line_by_edges
from semviz_core.detection.pole_ends import (
    all_ends,
    best_end,
    end_evidence,
    first_end,
    first_ends,
    within_image,
)
from semviz_core.detection.regions import Region
from semviz_core.detection.sign_centers import (
    SHAPES,
    center_by_model,
    centers_from_outline,
    shape_evidence,
    without_arms,
)
from semviz_core.research.paper.method import measure_as_in_paper
from semviz_core.subpixel import pole_ends as rows_end

STAGES = (
    ("line by ends", "line by mask", "line by box", "center by box", "center by mask"),
    ("line by edges", "center by outline"),
    ("end by model", "end by mask", "end by box"),
    ("end held", "end by growth"),
    ("end at sign", "end by rows"),
    ("end by edges",),
)
"""Each kind's evidence holds sigmas of kinds before it."""
_LARGEST_PX, _LARGEST_ALONG_PX = 8.0, 25.0
"""Errors count as this at most: one that is wrong altogether must not rule all others. Along poles
such errors are not rare, so sigma must hold them."""
_RIGHT_PX = 6.0
Regions = list[tuple[Shown, list[Region], IntArray]]


class Sample(NamedTuple):
    """One candidate: how far off it truly is."""

    kind: str
    evidence: FloatArray
    error_px: float


def fit(images: Regions) -> str:
    """The weights, as they stand in the module."""
    for stage in STAGES:
        if "end by rows" in stage:
            rows_end.WEIGHTS = np.array(_row_weights(images))
        by_kind = defaultdict(list)
        for sample in _samples(images):
            by_kind[sample.kind].append(sample)
        for kind in stage:
            if len(by_kind[kind]) > 20:
                most = _LARGEST_ALONG_PX if kind.startswith("end") else _LARGEST_PX
                sigma.WEIGHTS[kind] = likeliest(by_kind[kind], most)
    sigma.SHAPE = _shape_weights(images)
    sigma.KNOWN = _known_weights([*images, *_overgrown(images)])
    sigma.PAPER = _paper_sigmas(images)
    listed = [f'    "{kind}": {_listed(weights)},' for kind, weights in sigma.WEIGHTS.items()]
    return "\n".join(
        [
            "WEIGHTS = {", *listed, "}", f"KNOWN = {_listed(sigma.KNOWN)}",
            f"measuring.rows.WEIGHTS = np.array({_listed(rows_end.WEIGHTS)})",
            f"SHAPE = np.array({_listed(sigma.SHAPE)})", f"PAPER = {_listed(sigma.PAPER)}",
        ]
    )  # fmt: skip


def _samples(images: Regions) -> Iterator[Sample]:
    for image, regions, rows in images:
        signs = [region for region in regions if not is_pole(region)]
        for region, row in zip(regions, rows, strict=True):
            if is_pole(region):
                yield from _pole_samples(image, region, int(row), signs)
            else:
                yield from _sign_samples(image, region, int(row))


def _pole_samples(shown: Shown, region: Region, row: int, signs: list[Region]) -> Iterator[Sample]:
    truth = shown.whole.elements
    true = np.stack([truth.anchor_px[row], truth.end_px[row]])
    along = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
    normal = np.array([along[1], -along[0]])
    lines = first_lines(region)
    if not lines:
        return
    first = min(lines, key=lambda line: line.sigma_px)
    edges = line_by_edges(shown.picture, region, first)
    for line in [*lines, *([] if edges is None else [edges])]:
        for off in (line.ends_px - true[0]) @ normal:
            yield Sample(line.kind, line.evidence, float(off))
    best = best_line(shown.picture, region)
    assert best is not None
    middle, course_along = best.middle_px, best.along
    for which, known in enumerate((truth.anchor_known[row], truth.end_known[row])):
        if known:
            place = float((true[which] - middle) @ course_along)
            first = first_end(region, best, which)
            found = all_ends(shown.picture, region, best, signs, first)
            for end in [*first_ends(region, best, which), *found]:
                yield Sample(end.kind, end.evidence, end.place_px - place)


def _sign_samples(shown: Shown, region: Region, row: int) -> Iterator[Sample]:
    true = shown.whole.elements.anchor_px[row]
    first = center_by_model(region)
    class_id = int(shown.whole.elements.class_id[row])
    outlines = centers_from_outline(shown.picture, first, (class_id,))
    for middle in [first, *outlines[class_id]]:
        for off in middle.center_px - true:
            yield Sample(middle.kind, middle.evidence, float(off))


def likeliest(samples: list[Sample], largest_px: float = _LARGEST_PX) -> tuple[float, ...]:
    """Weights under which errors are likeliest: their sigma is exp of the weighted evidence."""
    X = np.array([sample.evidence for sample in samples])
    error = np.clip([sample.error_px for sample in samples], -largest_px, largest_px)
    mean, spread = X.mean(axis=0), X.std(axis=0) + 1e-6
    A = np.column_stack([np.ones(len(X)), (X - mean) / spread])

    def cost(weights: FloatArray) -> tuple[float, FloatArray]:
        log_sigma = np.clip(A @ weights, -5.0, 5.0)
        square = (error**2 + 0.05**2) * np.exp(-2.0 * log_sigma)
        value = (log_sigma + 0.5 * square).mean() + 1e-3 * (weights[1:] ** 2).sum()
        slope = A.T @ (1.0 - square) / len(A)
        slope[1:] += 2e-3 * weights[1:]
        return float(value), slope

    start = np.zeros(A.shape[1])
    start[0] = np.log(np.sqrt((error**2).mean()))
    weights = minimize(cost, start, jac=True, method="BFGS").x
    return _plain(weights, mean, spread)


def _plain(weights: FloatArray, mean: FloatArray, spread: FloatArray) -> tuple[float, ...]:
    """Of evidence as it is, from those of standardized evidence."""
    slopes = weights[1:] / spread
    return (round(float(weights[0] - slopes @ mean), 4), *(round(float(w), 4) for w in slopes))


def _row_weights(images: Regions) -> tuple[float, ...]:
    """Logistic regression of a row being the pole's, within 20 px of where the model ends it."""
    X, y = [], []
    for image, regions, true_rows in images:
        for region, row in zip(regions, true_rows, strict=True):
            line = best_line(image.picture, region) if is_pole(region) else None
            for which in range(2 if line is not None else 0):
                assert line is not None
                middle, along = line.middle_px, line.along
                first = first_end(region, line, which)
                end, other = middle + first.place_px * along, line.ends_px[1 - which]
                truth = image.whole.elements
                true = (truth.anchor_px, truth.end_px)[which][row]
                out = along if which else -along
                if (end - other) @ out > 6.0:
                    off, evidence = rows_end.row_evidence(
                        image.picture, other, end, line.width_px, 20.0
                    )
                    X.append(evidence)
                    y.append(off < (true - end) @ out)
    return _logistic(np.concatenate(X), np.concatenate(y).astype(np.float64))


def _overgrown(images: Regions) -> Regions:
    """The images with leaves before ends, as masks, each once."""
    each = {id(image): overgrown(image) for image, _, _ in images}
    return [(image, *masked_in_part(image)) for image in each.values()]


def _known_weights(images: Regions) -> tuple[float, ...]:
    """Logistic regression of an end being the pole's own and measured to ``_RIGHT_PX``, where the
    model does not call it hidden."""
    X, y = [], []
    for image, regions, rows in images:
        signs = [region for region in regions if not is_pole(region)]
        for region, row in zip(regions, rows, strict=True):
            line = best_line(image.picture, region) if is_pole(region) else None
            if line is None:
                continue
            first = [first_end(region, line, which) for which in range(2)]
            ends = [best_end(image.picture, region, line, signs, end) for end in first]
            middle, along = line.middle_px, line.along
            ends_px = middle + np.array([[end.place_px] for end in ends]) * along
            ends_px, cut = within_image(image.picture, ends_px)
            truth = image.whole.elements
            known = (truth.anchor_known[row], truth.end_known[row])
            true_px = np.stack([truth.anchor_px[row], truth.end_px[row]])
            off_px = np.abs((ends_px - true_px) @ along)
            for which in np.flatnonzero(~cut):
                if region.ends_known is None or region.ends_known[which]:
                    pair = (first[which], ends[which])
                    X.append(end_evidence(image.picture, region, line, ends_px, *pair))
                    y.append(known[which] and off_px[which] < _RIGHT_PX)
    return _logistic(np.array(X), np.array(y, dtype=np.float64))


def _logistic(X: FloatArray, y: FloatArray) -> tuple[float, ...]:
    A = np.column_stack([np.ones(len(X)), X])

    def cost(weights: FloatArray) -> float:
        odds = A @ weights
        return float((np.logaddexp(0.0, odds) - y * odds).mean() + 1e-3 * (weights[1:] ** 2).sum())

    return tuple(round(float(w), 4) for w in minimize(cost, np.zeros(A.shape[1])).x)


def _shape_weights(images: Regions) -> FloatArray:
    """Multinomial regression of a sign's class, with one set of weights; no sign has odds of 1."""
    X, which = [], []

    def add(image: Shown, region: Region, class_index: int) -> None:
        first = center_by_model(region)
        bodies = without_arms(region)
        outlines = centers_from_outline(image.picture, first, SHAPES, bodies)
        X.append(
            [shape_evidence([region, *bodies], shape, first, outlines[shape]) for shape in SHAPES]
        )
        which.append(class_index)

    for image, regions, rows in images:
        for region, row in zip(regions, rows, strict=True):
            if not is_pole(region):
                add(image, region, SHAPES.index(int(image.whole.elements.class_id[row])))
    for image in {id(image): image for image, _, _ in images}.values():
        for region in false_masks(image):
            add(image, region, len(SHAPES))
    A = np.array(X)

    def cost(weights: FloatArray) -> float:
        odds = np.concatenate([A @ weights, np.zeros((len(A), 1))], axis=1)
        own = odds[np.arange(len(odds)), which]
        total = np.logaddexp.reduce(odds, axis=1)
        return float((total - own).mean() + 1e-3 * (weights**2).sum())

    return np.asarray(np.round(minimize(cost, np.zeros(A.shape[2])).x, 4))


def _paper_sigmas(images: Regions) -> tuple[float, float]:
    """How far off the paper's measuring is across and along, on the whole."""
    across, along = [], []
    for image, regions, rows in images:
        for region, row in zip(regions, rows, strict=True):
            for found in [measure(image.picture, [region], measure_as_in_paper)]:
                if len(found):
                    errors = errors_px(found, image.whole.elements, 0, int(row))
                    across += list(errors.across)
                    along += list(errors.along)
    clipped = [np.clip(value, -_LARGEST_PX, _LARGEST_PX) for value in (across, along)]
    return (round(float(np.sqrt((clipped[0] ** 2).mean())), 2),
            round(float(np.sqrt((clipped[1] ** 2).mean())), 2))  # fmt: skip


class Errors(NamedTuple):
    """Of one element."""

    across: FloatArray
    """(2,) of a pole's ends; of a sign in both directions."""
    along: FloatArray
    """(k,) of a pole's ends that are known and said to be."""
    angle_deg: float
    """NaN for signs."""


def errors_px(found: Elements2D, truth: Elements2D, row: int, true_row: int) -> Errors:
    """How far off a measured element is."""
    here = np.stack([found.anchor_px[row], found.end_px[row]])
    true = np.stack([truth.anchor_px[true_row], truth.end_px[true_row]])
    if not found.is_line[row]:
        return Errors(here[0] - true[0], np.zeros(0), np.nan)
    along = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
    normal = np.array([along[1], -along[0]])
    step = here[1] - here[0]
    known = np.array([found.anchor_known[row], found.end_known[row]])
    known &= [truth.anchor_known[true_row], truth.end_known[true_row]]
    angle = float(np.rad2deg(np.arctan2(step @ normal, step @ along)))
    return Errors((here - true[0]) @ normal, ((here - true) @ along)[known], angle)


def _listed(values: object) -> str:
    return f"({', '.join(f'{float(value):g}' for value in np.asarray(values))})"

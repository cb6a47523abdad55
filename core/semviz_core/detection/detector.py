"""Detect poles and signs in images: a model finds regions, and each region is measured.

An axis, an end or a centre has several candidates, from the model's region and from edges in the
image. The candidate with the least predicted sigma is used. The measurement function is a
parameter of Detector.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeAlias

from semviz_core.base.classes import (
    DEFAULT_CLASSES,
    OLDER_CENTER,
    POLE,
    ClassSet,
    TriangleCenter,
    with_center,
)
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.jit import Stopwatch
from semviz_core.detection.foreign_models import HUB, OnnxModel, TransformersModel
from semviz_core.detection.pole_axes import best_line, line_over
from semviz_core.detection.pole_ends import pole_extent
from semviz_core.detection.regions import (
    MeasuredElement,
    Region,
    chosen_sigma_px,
    elements,
    suppress_duplicates,
)
from semviz_core.detection.sign_centers import best_center
from semviz_core.subpixel.sampling import SampledImage

MeasureRegion: TypeAlias = Callable[
    [SampledImage, Region, Sequence[Region]], MeasuredElement | None
]
"""Measures a region; None if it shows no element. The last argument are the regions of all signs in
the image, whose poles they may be."""


LEAST_SHAPE, LEAST_HALF_PX = 0.5, 3.0
"""Least probability of a sign's shape, and least half of its shorter side. Other regions are no
sign: a board, a bush, or too small to tell."""


def by_edges(
    image: SampledImage, region: Region, signs: Sequence[Region]
) -> MeasuredElement | None:
    """Measure a region by the edges in the image, to a fraction of a pixel."""
    return _pole(image, region, signs) if is_pole(region) else _sign(image, region)


def measure(
    image: SampledImage, regions: Sequence[Region], measure_region: MeasureRegion = by_edges
) -> Elements2D:
    """Return the elements in an image, at most one for each region, best score first.

    A triangular sign is at the middle of its box; ``triangle_center.converted`` converts it. A
    region outside the image or without extent shows none. Of regions of the same pole or sign, the
    one with the best score is kept.
    """
    ordered = sorted(regions, key=lambda region: -region.score)
    shown = [region for region in ordered if _in_image(image, region)]
    signs = [region for region in shown if not is_pole(region)]
    measured = [measure_region(image, region, signs) for region in shown]
    return elements(suppress_duplicates(region for region in measured if region is not None))


def is_pole(region: Region) -> bool:
    return region.class_id == POLE


def _pole(image: SampledImage, region: Region, signs: Sequence[Region]) -> MeasuredElement | None:
    line = best_line(image, region)
    if line is None:
        return None
    extent = pole_extent(image, region, line, signs)
    if extent is None:
        return None
    longer = line_over(image, region, line, extent.ends_px)
    across = chosen_sigma_px("across", longer.sigma_px)
    sigma = (across, chosen_sigma_px("along", extent.sigma_along_px))
    return MeasuredElement(POLE, region.score, longer.ends_px, sigma, extent.known, line.width_px)


def _sign(image: SampledImage, region: Region) -> MeasuredElement | None:
    class_id, center, probability = best_center(image, region)
    size = float(center.half_px.min())
    if probability < LEAST_SHAPE or size < LEAST_HALF_PX:
        return None
    sigma = (chosen_sigma_px("center", center.sigma_px),) * 2
    score = region.score * probability
    return MeasuredElement(
        class_id, score, center.center_px[None], sigma, (True, False), size, center.to_centroid_px
    )


def _in_image(image: SampledImage, region: Region) -> bool:
    height, width = image.image.shape[:2]
    low, high = region.box_px[:2], region.box_px[2:]
    inside = (high > -0.5).all() and (low < [width - 0.5, height - 0.5]).all()
    return bool(inside and (high - low).max() >= 1.0)


class RegionModel(Protocol):
    """A model that finds regions of poles and signs: the shipped network or an external model."""

    @property
    def name(self) -> str:
        """The model's name in proposals, runs and reports."""

    def find(self, image: ByteImage, watch: Stopwatch | None = None) -> Sequence[Region]:
        """Return the regions in an image (height, width, 3) sRGB, of any size.

        ``watch`` gets the times of the stages "network" and "regions", if the model knows them.
        Raise SemvizError if the model cannot take the image, or its output has another format than
        described.
        """


@dataclass(frozen=True)
class Detector:
    """Detects poles and signs in images."""

    model: RegionModel
    measure: MeasureRegion = by_edges
    """Measures one region."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the point of a triangular sign is; give that of the map to localize in."""
    time_ms: dict[str, list[float]] = field(default_factory=dict)
    """Wall time of each image so far, by stage."""

    def detect(self, image: ByteImage) -> Elements2D:
        """Return the elements in an image (height, width, 3) sRGB, best score first."""
        watch = Stopwatch()
        regions = self.model.find(image, watch)
        found = watch.time("measuring", lambda: measure(SampledImage(image), regions, self.measure))
        for stage, milliseconds in watch.time_ms.items():
            self.time_ms.setdefault(stage, []).append(milliseconds)
        return with_center(found, "box", self.triangle_center)


_KINDS = (
    "give *.safetensors of 'semviz detect train', a *.toml that describes an ONNX model, a folder "
    f"of a transformers model, or {HUB}NAME"
)


def load_region_model(
    model: str | None = None,
    classes: ClassSet = DEFAULT_CLASSES,
    least_score: float | None = None,
) -> RegionModel:
    """Load a model; default: the shipped one. Raise SemvizError if it cannot be loaded.

    ``least_score`` replaces the thresholds of weights; models of others have it in their TOML.
    """
    path = None if model is None else Path(model)
    if path is None or path.suffix == ".safetensors":
        require_extra("semviz's detector", "torch", "detect")
        from semviz_core.detection.network import load_shipped_model

        shipped = load_shipped_model(path, classes)
        return shipped if least_score is None else shipped.from_score(least_score)
    if path.suffix == ".toml":
        return OnnxModel.load(path, classes)
    if str(model).startswith(HUB) or (path / "config.json").is_file():
        return TransformersModel.load(str(model), classes)
    if path.suffix == ".onnx":
        raise SemvizError(f"{path}: name the TOML that describes this model (docs/detector.md)")
    raise SemvizError(f"{path}: not a model that semviz can read; {_KINDS}")


def load_detector(
    model: str | None = None,
    measure: MeasureRegion = by_edges,
    classes: ClassSet = DEFAULT_CLASSES,
    least_score: float | None = None,
) -> Detector:
    """Return a detector with ``load_region_model`` and a function that measures regions."""
    return Detector(load_region_model(model, classes, least_score), measure)

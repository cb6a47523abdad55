"""From the maps of a segmenter to regions: a thick pole of which only the edges are marked."""

from pathlib import Path

import numpy as np

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.detection.model_config import ImagePlacement, Maps, model_classes
from semviz_core.detection.postprocessing import mask_regions

HEIGHT, WIDTH = 160, 120
CLASSES = model_classes(("pole", "rest"), {"pole": "pole"}, DEFAULT_CLASSES, Path("model.toml"))
WHOLE = ImagePlacement((WIDTH, HEIGHT), (WIDTH, HEIGHT), np.ones(2), np.zeros(2))


def edges_only(between: float, gap: int = 8, rows: int = 100) -> Maps:
    """Two upright bars of 5 px, with the probability of a pole between them."""
    pole = np.full((HEIGHT, WIDTH), 0.02, np.float32)
    right = 55 + gap
    pole[20 : 20 + rows, 50 : right + 5] = between
    pole[20 : 20 + rows, 50:55] = pole[20 : 20 + rows, right : right + 5] = 0.9
    return np.stack([pole, 1.0 - pole])


def test_the_two_edges_of_a_thick_pole_are_one_pole() -> None:
    regions = mask_regions(edges_only(between=0.35), CLASSES, WHOLE, 0.3)
    assert len(regions) == 1
    assert regions[0].box_px.tolist() == [50.0, 20.0, 67.0, 119.0]


def test_two_poles_side_by_side_stay_two() -> None:
    apart = [
        edges_only(between=0.02),  # background between them
        edges_only(between=0.35, gap=25),
        edges_only(between=0.35, rows=40),  # far away, where poles are thin
    ]
    for maps in apart:
        assert len(mask_regions(maps, CLASSES, WHOLE, 0.3)) == 2

"""Regions to elements: axes, ends and middles measured in the image, each with its sigma.

Of all that an axis, an end or a middle could be, by the model's word and by edges in the image,
the one with the least predicted sigma counts.
"""

from collections.abc import Sequence
from typing import Literal

from semviz_core.classes import POLE
from semviz_core.detection.ends import extent
from semviz_core.detection.line import best_line
from semviz_core.detection.measured import Measured, elements, without_repeats
from semviz_core.detection.middle import best_middle
from semviz_core.detection.paper import by_the_paper
from semviz_core.detection.region import Region
from semviz_core.detection.sigma import chosen_sigma_px
from semviz_core.elements import Elements2D
from semviz_core.measuring.picture import Picture

Measuring = Literal["edges", "paper"]


def measure(picture: Picture, regions: Sequence[Region], measuring: Measuring) -> Elements2D:
    """The elements in a picture, one for each region that shows one, best score first.

    A region outside of the image or without any extent shows none. Of regions that come to the
    same pole or sign, the best stays.
    """
    ordered = sorted(regions, key=lambda one: -one.score)
    shown = [one for one in ordered if _in_image(picture, one)]
    if measuring == "paper":
        found = [by_the_paper(picture, one) for one in shown]
    else:
        signs = [one for one in shown if not is_pole(one)]
        found = [_measured(picture, one, signs) for one in shown]
    return elements(without_repeats(one for one in found if one is not None))


def is_pole(region: Region) -> bool:
    return region.class_id == POLE


def _measured(picture: Picture, region: Region, signs: Sequence[Region]) -> Measured | None:
    return _pole(picture, region, signs) if is_pole(region) else _sign(picture, region)


def _pole(picture: Picture, region: Region, signs: Sequence[Region]) -> Measured | None:
    line = best_line(picture, region)
    if line is None:
        return None
    found = extent(picture, region, line, signs)
    if found is None:
        return None
    across = chosen_sigma_px("across", line.sigma_px)
    sigma = (across, chosen_sigma_px("along", found.sigma_along_px))
    return Measured(POLE, region.score, found.ends_px, sigma, found.known, line.width_px)


def _sign(picture: Picture, region: Region) -> Measured | None:
    class_id, middle = best_middle(picture, region)
    sigma = (chosen_sigma_px("middle", middle.sigma_px),) * 2
    size = float(middle.half_px.min())
    return Measured(class_id, region.score, middle.middle_px[None], sigma, (True, False), size)


def _in_image(picture: Picture, region: Region) -> bool:
    height, width = picture.image.shape[:2]
    low, high = region.box_px[:2], region.box_px[2:]
    inside = (high > -0.5).all() and (low < [width - 0.5, height - 0.5]).all()
    return bool(inside and (high - low).max() >= 1.0)

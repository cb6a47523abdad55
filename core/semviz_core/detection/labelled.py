"""Images whose poles and signs are known: what a detector learns from."""

from dataclasses import dataclass
from typing import Any, Protocol

from semviz_core.arrays import BoolArray, ByteImage, bool_array
from semviz_core.detection.region import Region
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and what it shows."""

    image: ByteImage
    """(height, width, 3) sRGB."""
    elements: Elements2D
    """(m,) those to be found. Elsewhere there is nothing to find, unless it is ``ignored``."""
    regions: tuple[Region, ...] | None = None
    """(m,) with masks; None where only points and lines are labelled: nothing is then learned of
    sizes and masks."""
    ignored: BoolArray | None = None
    """(height, width) pixels of which nobody says whether an element is there: far ones, tiny
    ones; nothing is learned from them."""

    def __post_init__(self) -> None:
        if self.regions is not None and len(self.regions) != len(self.elements):
            raise SemvizError(
                f"{len(self.elements)} elements and {len(self.regions)} regions: give one each"
            )
        if self.ignored is not None:
            shape = self.image.shape[:2]
            object.__setattr__(self, "ignored", bool_array(self.ignored, shape, "ignored"))


class LabelledImages(Protocol):
    """Labelled images by number: always the same for the same number. Picklable, and small then;
    used in worker processes."""

    @property
    def count(self) -> int:
        """Of the images to train on, 1 or more."""

    @property
    def held_out_count(self) -> int:
        """Of those that are never trained on, 1 or more."""

    def image(self, number: int) -> LabelledImage:
        """To train on; ``number`` is below ``count``. Raises SemvizError where it can't be read."""

    def held_out(self, number: int) -> LabelledImage:
        """Never trained on; ``number`` is below ``held_out_count``."""

    def describe(self) -> dict[str, Any]:
        """Where they come from, as JSON: kept in checkpoints and told in cards. It differs where
        images or labels do."""

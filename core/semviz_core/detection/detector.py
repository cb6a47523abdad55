"""The detector on one screen: a model finds regions, what is in them is measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from semviz_core.arrays import ByteImage
from semviz_core.detection.measure import Measuring, measure
from semviz_core.detection.region import Region
from semviz_core.elements import Elements2D
from semviz_core.measuring.picture import Picture


class Finder(Protocol):
    """A model that looks at images: our network, or other people's."""

    @property
    def name(self) -> str:
        """What people call it: in proposals, runs and reports."""

    def find(self, image: ByteImage) -> Sequence[Region]:
        """What it sees in an image (height, width, 3) sRGB, of any size.

        Raises SemvizError where the model cannot take the image, or answers otherwise than told.
        """


@dataclass(frozen=True)
class Detector:
    """Finds poles and signs in images."""

    finder: Finder
    measuring: Measuring = "edges"
    """How regions become elements; ``paper``: Canny and morphology, as the paper has it."""

    def detect(self, image: ByteImage) -> Elements2D:
        """The elements in an image (height, width, 3) sRGB, the most certain first."""
        return measure(Picture(image), self.finder.find(image), self.measuring)

"""Stand-ins for models that find poles and signs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from time import sleep

import numpy as np

from semviz_core.arrays import ByteImage
from semviz_core.classes import POLE
from semviz_core.detection.region import Region
from semviz_core.detection.rendered import rendered_truth
from semviz_core.sources.street.street import Street


@dataclass
class Knowing:
    """Finds what a street's image shows but for every seventh, and something false in each."""

    street: Street
    wait_s: float = 0.0
    """How long an image takes."""
    name: str = "knowing"
    _seen: dict[str, tuple[Region, ...]] = field(default_factory=dict)

    def find(self, image: ByteImage) -> Sequence[Region]:
        sleep(self.wait_s)
        regions = self._regions(image)
        kept = [one for row, one in enumerate(regions) if row % 7 != 3]
        return [*kept, FALSE]

    def _regions(self, image: ByteImage) -> tuple[Region, ...]:
        """Images are told apart by their pixels: a finder knows nothing else of them."""
        if not self._seen:
            for frame in self.street.frames:
                for side in ("left", "right"):
                    pixels = self.street.image(frame.index, side).tobytes()
                    truth = rendered_truth(self.street, frame.index, side)
                    self._seen[sha256(pixels).hexdigest()] = truth.regions
        return self._seen[sha256(image.tobytes()).hexdigest()]


FALSE = Region(
    POLE, 0.3, np.array([600.0, 20.0, 604.0, 90.0]),
    ends_px=np.array([[602.0, 20.0], [602.0, 90.0]]), ends_known=(True, False),
)  # fmt: skip
"""A pole in the sky."""

"""Where a model sees an element in an image, before its edges are measured."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, bool_array, float_array
from semviz_core.errors import SemvizError


@dataclass(frozen=True, eq=False)
class Region:
    """One pole or sign as a model found it. Pixel (0, 0) is the centre of the top-left pixel."""

    class_id: int | None
    """None: a sign whose shape the model does not tell."""
    score: float
    """The model's confidence in [0, 1]."""
    box_px: FloatArray
    """(4,) left, top, right, bottom."""
    mask: BoolArray | None = None
    """(height, width) of the element's pixels, the first of them ``corner_px``; None without."""
    corner_px: tuple[int, int] = (0, 0)
    """Column and row of the mask's first pixel."""
    ends_px: FloatArray | None = None
    """(2, 2) peak and bottom of a pole where the model tells them, to a few pixels."""
    ends_known: tuple[bool, bool] | None = None
    """Whether peak and bottom can be seen, neither hidden nor cut off, if the model tells."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "box_px", float_array(self.box_px, (4,), "box_px"))
        if (self.box_px[2:] < self.box_px[:2]).any():
            raise SemvizError(f"box_px {self.box_px.tolist()}: give left, top, right, bottom")
        if self.mask is not None:
            object.__setattr__(self, "mask", bool_array(self.mask, (None, None), "mask"))
        if self.ends_px is not None:
            object.__setattr__(self, "ends_px", float_array(self.ends_px, (2, 2), "ends_px"))
        if not 0.0 <= self.score <= 1.0:
            raise SemvizError(f"score {self.score:g}: give a number from 0 to 1")

    @property
    def middle_px(self) -> FloatArray:
        """(2,) of the box."""
        return np.asarray((self.box_px[:2] + self.box_px[2:]) / 2.0)

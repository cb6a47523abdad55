"""Objects of a simulated street as plain values in the map frame (metres, z up).

A lamp's arm and head are not part of the ground truth of its pole.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import FloatArray

Color = tuple[float, float, float]
"""sRGB, 0 to 255."""
FloatPicture = NDArray[np.float32]
"""(height, width) or (height, width, channels)."""
PoleKind = Literal["post", "lamp", "mast"]
SectionKind = Literal["normal", "sparse", "row"]
SignLook = Literal["new", "plank", "street name", "board", "number", "back", "faded"]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Pole:
    """A straight round pole; a lamp's arm and head are not part of the truth."""

    id: int
    kind: PoleKind
    bottom_m: FloatArray
    """(3,) on the pavement."""
    peak_m: FloatArray
    """(3,) top of the axis; where a lamp's arm begins."""
    radius_m: float
    color: Color
    arm_m: FloatArray
    """(3,) from the peak to the lamp's head; zero without an arm."""


@dataclass(frozen=True, eq=False)
class Sign:
    """A flat sign on a pole, facing the traffic."""

    id: int
    class_id: int
    middle_m: FloatArray
    """(3,) centre of the plate's bounding box."""
    right_m: FloatArray
    """(3,) from the centre to the plate's right edge, seen from the front; horizontal."""
    up_m: FloatArray
    """(3,) from the centre to its upper edge."""
    face: int
    """Number that selects one of the class's faces, or of the look's."""
    pole_id: int
    look: SignLook = "new"


@dataclass(frozen=True, eq=False)
class Car:
    """A parked car."""

    middle_m: FloatArray
    """(3,) on the ground."""
    heading_rad: float
    scale: tuple[float, float, float]
    """Length, width and height relative to the model."""
    hatchback: bool
    color: Color

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) from the car's axes: x forward, y left, z up."""
        sin, cos = np.sin(self.heading_rad), np.cos(self.heading_rad)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    @property
    def corners_m(self) -> FloatArray:
        """(4, 3) of the ground it stands on."""
        corners = np.array([(-2.1, -0.8, 0.0), (2.1, -0.8, 0.0), (2.1, 0.8, 0.0), (-2.1, 0.8, 0.0)])
        return np.asarray(self.middle_m + corners * self.scale @ self.rotation.T)


@dataclass(frozen=True, eq=False)
class Tree:
    """A trunk under a crown of leaves; a bush has a trunk of length 0."""

    root_m: FloatArray
    trunk_m: float
    crown_m: tuple[float, float]
    """Width and height of the crown."""
    sprite: int
    across_m: FloatArray
    """(3,) horizontal unit vector along the crown's width, across the road."""


@dataclass(frozen=True, eq=False)
class Hedge:
    """A clipped hedge or a low wall: a box along the road."""

    begin_m: FloatArray
    end_m: FloatArray
    """(3,) corners on the ground at the road's side."""
    depth_m: FloatArray
    """(3,) away from the road."""
    height_m: float
    leafy: bool


@dataclass(frozen=True, eq=False)
class House:
    """A house whose front and eaves run along the road."""

    corner_m: FloatArray
    """(3,) front corner that traffic passes first."""
    front_m: FloatArray
    """(3,) along the front."""
    depth_m: FloatArray
    """(3,) away from the road."""
    height_m: float
    """Of the eaves."""
    roof_m: float
    """Of the ridge above the eaves."""
    style: int
    """Seed of its walls, windows and colours."""


StandingObject: TypeAlias = Car | Pole | Sign
"""An object beside the road that can hide others and be hidden."""

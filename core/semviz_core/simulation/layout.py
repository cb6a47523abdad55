"""Lay out a street: the road, the objects beside it, and the camera's path.

The road is a smooth centreline on an inclined plane, straight within given sections. Poles and
signs follow the benchmark: 40 % posts of 2.2-3.3 m, 40 % lamps of 4-8 m, 20 % masts of 3-5 m,
tilted by 0.7 deg; signs on 75 % of the posts and 15 % of the lamps.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.simulation import objects
from semviz_core.simulation.sign_faces import worn

LANE_M = 3.4
PARKING_M = 2.1
KERB_M = LANE_M + PARKING_M
"""From the centreline to the kerb."""
KERB_HEIGHT_M = 0.12
PAVEMENT_M = KERB_M + 2.6
"""From the centreline to the pavement's far edge."""

_STEP_M = 0.5


@dataclass(frozen=True, eq=False)
class RoadGeometry:
    """A centreline, defined from ``s_m[0]`` to ``s_m[-1]``.

    Road coordinates are (s, d, h): metres along the centreline, to the left of it, and above the
    road's plane.
    """

    s_m: FloatArray
    """(k,) increasing."""
    xy_m: FloatArray
    """(k, 2)"""
    heading_rad: FloatArray
    """(k,) continuous."""
    slope: FloatArray
    """(2,) rise of the ground along x and y."""

    def heading(self, s_m: float | FloatArray) -> FloatArray:
        """Return (n,) the road's heading, from x towards y."""
        return np.asarray(np.interp(s_m, self.s_m, self.heading_rad))

    def forward(self, s_m: float) -> FloatArray:
        """Return the horizontal unit vector (3,) along the road."""
        heading = float(self.heading(s_m))
        return np.array([np.cos(heading), np.sin(heading), 0.0])

    def left(self, s_m: float) -> FloatArray:
        """Return the horizontal unit vector (3,) to the left of the road."""
        x, y, _ = self.forward(s_m)
        return np.array([-y, x, 0.0])

    def at(
        self, s_m: float | FloatArray, d_m: float | FloatArray, h_m: float | FloatArray = 0.0
    ) -> FloatArray:
        """Return points in the map frame: (n, 3), or (3,) for a single one."""
        s, d, h = np.broadcast_arrays(
            *(np.asarray(value, dtype=float) for value in (s_m, d_m, h_m))
        )
        heading = self.heading(s)
        x = np.interp(s, self.s_m, self.xy_m[:, 0]) - np.sin(heading) * d
        y = np.interp(s, self.s_m, self.xy_m[:, 1]) + np.cos(heading) * d
        return np.stack([x, y, self.slope[0] * x + self.slope[1] * y + h], axis=-1)

    def ground(self, points_m: FloatArray) -> FloatArray:
        """Return points (..., 3) moved vertically to the height of the pavement."""
        height = points_m[..., :2] @ self.slope + KERB_HEIGHT_M
        return np.concatenate([points_m[..., :2], height[..., None]], axis=-1)


def make_road(
    rng: np.random.Generator, begin_m: float, end_m: float, straight: list[tuple[float, float]]
) -> RoadGeometry:
    """Return a winding road that is straight within the given (begin, end) stretches."""
    s = np.arange(begin_m, end_m + _STEP_M, _STEP_M)
    curvature = np.zeros_like(s)
    for wavelength in (75.0, 120.0, 190.0):
        phase = rng.uniform(0.0, 2.0 * np.pi)
        curvature += rng.uniform(0.5, 1.0) / 350.0 * np.sin(2.0 * np.pi * s / wavelength + phase)
    for begin, end in straight:
        outside = np.maximum(begin - s, s - end)
        curvature *= np.clip(outside / 15.0, 0.0, 1.0)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature) * _STEP_M
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1) * _STEP_M
    xy = np.cumsum(steps, axis=0)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slope = rng.uniform(0.0, 0.02) * np.array([np.cos(direction), np.sin(direction)])
    return RoadGeometry(s, xy - xy[np.searchsorted(s, 0.0)], heading, slope)


BEHIND_M = 25.0
AHEAD_M = 130.0
"""Length of the street before the first and after the last camera."""
ROW_SPACING_M = 5.0
ROW_HEIGHT_M = 3.0
SIGN_SHARE: dict[objects.PoleKind, float] = {"post": 0.75, "lamp": 0.15, "mast": 0.0}
SIGN_CLASSES = (TRIANGULAR, RECTANGULAR, ROUNDED)
CLASS_SHARE = (0.25, 0.45, 0.30)
TILT_RAD = float(np.deg2rad(0.7))

_METAL: tuple[objects.Color, ...] = (
    (150, 154, 158),
    (124, 129, 134),
    (92, 104, 98),
    (104, 106, 112),
)
_PAINT: tuple[objects.Color, ...] = (
    (196, 200, 204),
    (46, 50, 56),
    (148, 40, 38),
    (38, 66, 116),
    (92, 98, 104),
    (224, 222, 214),
    (64, 92, 80),
    (150, 132, 102),
)


@dataclass(frozen=True)
class Section:
    """A stretch of road with one density of elements.

    ``normal``: 6-15 elements within 40 m; ``sparse``: 1-3; ``row``: only equal, equally spaced
    poles on both sides of a straight road, so positions are ambiguous. A camera detects elements up
    to 40 m ahead, so it sees a single section until 40 m before its end.
    """

    kind: objects.SectionKind
    length_m: float


@dataclass(frozen=True)
class StreetOptions:
    """Length of the drive, and sections of the street.

    The sections begin at the first camera; the last one continues to the end of the street.
    """

    frames: int = 60
    spacing_m: float = 1.0
    sections: tuple[Section, ...] = (Section("normal", 100.0),)
    signs: Literal["new", "worn"] = "new"
    """Worn signs are as on real streets; everything else stays the same."""

    def __post_init__(self) -> None:
        if self.frames < 1 or not self.spacing_m > 0:
            raise SemvizError("a street needs at least 1 frame and a positive spacing")
        if not self.sections or any(not section.length_m > 0 for section in self.sections):
            raise SemvizError("a street needs at least 1 section, each of positive length")

    @property
    def length_m(self) -> float:
        """Distance from the first to the last camera."""
        return (self.frames - 1) * self.spacing_m


@dataclass(frozen=True, eq=False)
class Layout:
    """All objects of a street."""

    road: RoadGeometry
    sun: FloatArray
    """(3,) unit vector towards the sun."""
    poles: tuple[objects.Pole, ...]
    signs: tuple[objects.Sign, ...]
    cars: tuple[objects.Car, ...]
    trees: tuple[objects.Tree, ...]
    hedges: tuple[objects.Hedge, ...]
    houses: tuple[objects.House, ...]

    @cached_property
    def standing(self) -> tuple[tuple[objects.StandingObject, ...], FloatArray]:
        """The n cars, poles and signs, and their (n, 4, 2) corners on the ground."""
        standing: tuple[objects.StandingObject, ...] = (*self.cars, *self.poles, *self.signs)
        corners = [car.corners_m[:, :2] for car in self.cars]
        corners += [np.tile(pole.bottom_m[:2], (4, 1)) for pole in self.poles]
        corners += [np.tile(sign.middle_m[:2], (4, 1)) for sign in self.signs]
        return standing, np.array(corners).reshape(-1, 4, 2)


def lay_out_street(seed: int, options: StreetOptions) -> Layout:
    """Return the layout of the street of this seed."""
    rng = np.random.default_rng([seed, 0])
    stretches = _stretches(options)
    straight = [(begin, end) for kind, begin, end in stretches if kind == "row"]
    begin, end = stretches[0][1], stretches[-1][2]
    road = make_road(rng, begin - 10.0, end + 10.0, straight)
    builder = _Builder(road, rng)
    for kind, begin, end in stretches:
        builder.furnish(kind, begin, end)
        for side in (-1, 1):
            builder.park_cars(kind, side, begin, end)
            builder.border(kind, side, begin, end)
    layout = builder.layout()
    if options.signs == "new":
        return layout
    wear = np.random.default_rng([seed, 5])
    return replace(layout, signs=tuple(worn(sign, wear) for sign in layout.signs))


def with_other_cars(layout: Layout, options: StreetOptions, seed: int) -> Layout:
    """Return the same street on another day: with other parked cars."""
    builder = _Builder(layout.road, np.random.default_rng([seed, 6]))
    for kind, begin, end in _stretches(options):
        for side in (-1, 1):
            builder.park_cars(kind, side, begin, end)
    return replace(layout, cars=tuple(builder.cars))


def _stretches(options: StreetOptions) -> list[tuple[objects.SectionKind, float, float]]:
    """Return (kind, begin, end) along the road; first and last reach to the street's ends."""
    ends = np.cumsum([section.length_m for section in options.sections])
    ends[-1] = max(float(ends[-1]), options.length_m + AHEAD_M)
    begins = np.concatenate([[-BEHIND_M], ends[:-1]])
    kinds = [section.kind for section in options.sections]
    return [
        (kind, float(begin), float(end))
        for kind, begin, end in zip(kinds, begins, ends, strict=True)
    ]


@dataclass
class _Builder:
    """Places objects beside a road, in the order of the random numbers."""

    road: RoadGeometry
    rng: np.random.Generator
    poles: list[tuple[float, objects.Pole, objects.Sign | None]] = field(default_factory=list)
    cars: list[objects.Car] = field(default_factory=list)
    trees: list[objects.Tree] = field(default_factory=list)
    hedges: list[objects.Hedge] = field(default_factory=list)
    houses: list[objects.House] = field(default_factory=list)

    def layout(self) -> Layout:
        """Return the layout, with elements numbered along the road from 1."""
        poles: list[objects.Pole] = []
        signs: list[objects.Sign] = []
        number = 0
        for _, pole, sign in sorted(self.poles, key=lambda row: row[0]):
            number += 1
            poles.append(replace(pole, id=number))
            if sign is not None:
                number += 1
                signs.append(replace(sign, id=number, pole_id=poles[-1].id))
        return Layout(
            road=self.road,
            sun=self._sun(),
            poles=tuple(poles),
            signs=tuple(signs),
            cars=tuple(self.cars),
            trees=tuple(self.trees),
            hedges=tuple(self.hedges),
            houses=tuple(self.houses),
        )

    def _sun(self) -> FloatArray:
        """Return the sun's direction, behind the camera and to one side."""
        azimuth = float(self.road.heading(0.0)) + np.pi
        azimuth += self.rng.choice([-1.0, 1.0]) * self.rng.uniform(0.7, 1.2)
        elevation = self.rng.uniform(0.65, 0.9)
        level = np.cos(elevation)
        return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])

    def furnish(self, kind: objects.SectionKind, begin: float, end: float) -> None:
        """Add poles and their signs."""
        if kind == "row":
            for s in np.arange(begin + ROW_SPACING_M / 2, end, ROW_SPACING_M):
                for side in (-1, 1):
                    self._row_pole(float(s), side)
        elif kind == "sparse":
            s, side = begin + self.rng.uniform(8.0, 14.0), self.rng.choice([-1, 1])
            while s < end - 4.0:
                self._pole(s, side, sign=False)
                s, side = s + self.rng.uniform(15.0, 20.0), -side
        else:
            for side in (-1, 1):
                s = begin + self.rng.uniform(1.0, 7.0)
                while s < end - 2.0:
                    self._pole(s, side, sign=True)
                    s += self.rng.uniform(5.5, 12.0)

    def _row_pole(self, s: float, side: int) -> None:
        bottom = self.road.at(s, side * (KERB_M + 0.5), KERB_HEIGHT_M)
        peak = bottom + ROW_HEIGHT_M * objects.UP
        pole = objects.Pole(0, "post", bottom, peak, 0.05, _METAL[0], np.zeros(3))
        self.poles.append((s + 0.01 * side, pole, None))

    def _pole(self, s: float, side: int, sign: bool) -> None:
        kinds: tuple[objects.PoleKind, ...] = ("post", "lamp", "mast")
        kind = kinds[self.rng.choice(3, p=(0.4, 0.4, 0.2))]
        reach = {"post": (0.35, 0.7), "lamp": (0.35, 0.6), "mast": (0.4, 2.3)}[kind]
        height = self.rng.uniform(*{"post": (2.2, 3.3), "lamp": (4.0, 8.0), "mast": (3, 5)}[kind])
        radius = {"post": 0.038, "lamp": 0.05 + 0.005 * height, "mast": 0.065}[kind]
        bottom = self.road.at(s, side * (KERB_M + self.rng.uniform(*reach)), KERB_HEIGHT_M)
        axis = objects.UP + np.append(self.rng.normal(0.0, TILT_RAD, 2), 0.0)
        axis /= np.linalg.norm(axis)
        plate = None
        if sign and self.rng.random() < SIGN_SHARE[kind]:
            plate, top = self._sign(s, bottom, axis, radius)
            height = max(height, top)
        color = _METAL[self.rng.integers(len(_METAL))]
        if kind == "mast" and self.rng.random() < 0.5:
            color = (112.0, 86.0, 62.0)  # wood
        arm = np.zeros(3)
        if kind == "lamp":
            arm = -side * self.rng.uniform(1.0, 1.9) * self.road.left(s) + 0.2 * objects.UP
        pole = objects.Pole(0, kind, bottom, bottom + height * axis, radius, color, arm)
        self.poles.append((s + 0.01 * side, pole, plate))

    def _sign(
        self, s: float, bottom: FloatArray, axis: FloatArray, radius: float
    ) -> tuple[objects.Sign, float]:
        """Return a sign in front of a pole, and the height of its upper edge along the pole."""
        class_id = int(self.rng.choice(SIGN_CLASSES, p=CLASS_SHARE))
        size = self.rng.uniform(0.9, 1.1)
        face = int(self.rng.integers(1 << 16))
        half = {
            TRIANGULAR: np.array([0.42, 0.37]),
            RECTANGULAR: np.array([(0.32, 0.32), (0.28, 0.42), (0.46, 0.30)][face % 3]),
            ROUNDED: np.array([0.32, 0.32]),
        }[class_id] * size
        height = min(self.rng.uniform(2.0, 2.9), 3.25 - half[1])
        yaw = float(self.road.heading(s)) + self.rng.normal(0.0, np.deg2rad(5.0))
        facing = -np.array([np.cos(yaw), np.sin(yaw), 0.0])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        middle = bottom + height * axis + (radius + 0.03) * facing
        sign = objects.Sign(0, class_id, middle, half[0] * right, half[1] * objects.UP, face, 0)
        return sign, height + float(half[1]) + 0.07  # the pole's peak stays visible

    def park_cars(self, kind: objects.SectionKind, side: int, begin: float, end: float) -> None:
        """Add parked cars; none beside a row, whose poles must look alike."""
        share = {"normal": 0.24, "sparse": 0.2, "row": 0.0}[kind]
        for s in np.arange(begin + 3.5, end - 3.0, 6.4):
            if self.rng.random() > share:
                continue
            place = s + self.rng.uniform(-0.5, 0.5)
            d = side * (LANE_M + PARKING_M / 2 + self.rng.uniform(-0.1, 0.15))
            turn = np.pi if side > 0 else 0.0
            self.cars.append(
                objects.Car(
                    middle_m=self.road.at(place, d),
                    heading_rad=float(self.road.heading(place)) + turn + self.rng.normal(0, 0.02),
                    scale=tuple(self.rng.uniform((0.88, 0.96, 0.95), (1.04, 1.02, 1.12))),
                    hatchback=bool(self.rng.random() < 0.6),
                    color=_PAINT[self.rng.integers(len(_PAINT))],
                )
            )

    def border(self, kind: objects.SectionKind, side: int, begin: float, end: float) -> None:
        """Add houses, hedges and trees behind the pavement, plot by plot."""
        s = begin
        while s < end - 5.0:
            length = min(self.rng.uniform(13.0, 20.0), end - s)
            built = kind == "normal" and self.rng.random() < 0.62 and length > 11.0
            if built:
                self._house(s, side, length)
            if kind == "normal" and self.rng.random() < 0.75:
                self._hedge(s, side, length)
            self._trees(s, side, length, {"normal": 1 if built else 3, "sparse": 2, "row": 2}[kind])
            s += length

    def _house(self, s: float, side: int, length: float) -> None:
        width = min(self.rng.uniform(8.5, 13.0), length - 2.0)
        begin = s + 0.6 * (length - width)
        d = side * self.rng.uniform(11.5, 14.5)
        corner = self.road.at(begin, d, KERB_HEIGHT_M)
        floors = self.rng.choice([1, 2, 3], p=(0.2, 0.6, 0.2))
        self.houses.append(
            objects.House(
                corner_m=corner,
                front_m=self.road.ground(corner + width * self.road.forward(begin + width / 2))
                - corner,
                depth_m=side * self.rng.uniform(7.0, 9.5) * self.road.left(begin + width / 2),
                height_m=2.85 * floors + 0.5,
                roof_m=self.rng.uniform(2.2, 3.6),
                style=int(self.rng.integers(1 << 30)),
            )
        )

    def _hedge(self, s: float, side: int, length: float) -> None:
        leafy = bool(self.rng.random() < 0.65)
        height = self.rng.uniform(0.9, 1.5) if leafy else self.rng.uniform(0.5, 0.9)
        d, depth = side * (PAVEMENT_M + 0.25), 0.8 if leafy else 0.25
        ends = np.linspace(s + 0.4, s + length - self.rng.uniform(0.4, 4.0), 5)
        for begin, end in pairwise(ends.tolist()):
            self.hedges.append(
                objects.Hedge(
                    begin_m=self.road.at(begin, d, KERB_HEIGHT_M),
                    end_m=self.road.at(end, d, KERB_HEIGHT_M),
                    depth_m=side * depth * self.road.left(begin),
                    height_m=height,
                    leafy=leafy,
                )
            )

    def _trees(self, s: float, side: int, length: float, count: int) -> None:
        for _ in range(count):
            place = s + self.rng.uniform(0.0, length)
            bush = self.rng.random() < 0.3
            reach = (2.8, 4.0) if self.rng.random() < 0.5 else (8.0, 18.0)
            d = side * (PAVEMENT_M + self.rng.uniform(*reach))
            size = self.rng.uniform(0.4, 0.7) if bush else self.rng.uniform(0.8, 1.4)
            self.trees.append(
                objects.Tree(
                    root_m=self.road.at(place, d, KERB_HEIGHT_M),
                    trunk_m=0.0 if bush else self.rng.uniform(1.6, 2.4),
                    crown_m=(4.2 * size, (3.0 if bush else 5.0) * size),
                    sprite=int(self.rng.integers(1 << 16)),
                    across_m=self.road.left(place),
                )
            )

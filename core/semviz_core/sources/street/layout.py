"""Lays out a street: what stands where, and how the camera drives past it.

Figures of poles and signs after the benchmark: 40 % posts of 2.2-3.3 m, 40 % lamps of 4-8 m,
20 % masts of 3-5 m, tilted by 0.7 deg; signs on 75 % of the posts and 15 % of the lamps.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.errors import SemvizError
from semviz_core.sources.street.road import (
    KERB_HEIGHT_M,
    KERB_M,
    LANE_M,
    PARKING_M,
    PAVEMENT_M,
    Road,
    make_road,
)
from semviz_core.sources.street.things import (
    UP,
    Car,
    Color,
    Hedge,
    House,
    Pole,
    PoleKind,
    SectionKind,
    Sign,
    Standing,
    Tree,
)

BEHIND_M = 25.0
AHEAD_M = 130.0
"""How far the street goes on before the first and after the last camera."""
ROW_SPACING_M = 5.0
ROW_HEIGHT_M = 3.0
SIGN_SHARE: dict[PoleKind, float] = {"post": 0.75, "lamp": 0.15, "mast": 0.0}
SIGN_CLASSES = (TRIANGULAR, RECTANGULAR, ROUNDED)
CLASS_SHARE = (0.25, 0.45, 0.30)
TILT_RAD = float(np.deg2rad(0.7))

_METAL: tuple[Color, ...] = ((150, 154, 158), (124, 129, 134), (92, 104, 98), (104, 106, 112))
_PAINT: tuple[Color, ...] = (
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
    """A stretch of road furnished in one way.

    ``normal``: 6-15 elements within 40 m; ``sparse``: 1-3; ``row``: equal, equally spaced poles on
    both sides of a straight road and nothing else, so that one place looks like the next. A
    camera looks 40 m ahead: it sees a section alone until 40 m before its end.
    """

    kind: SectionKind
    length_m: float


@dataclass(frozen=True)
class StreetOptions:
    """How long a drive is, and past what.

    The sections begin at the first camera; the last one goes on to the end of the street.
    """

    frames: int = 60
    spacing_m: float = 1.0
    sections: tuple[Section, ...] = (Section("normal", 100.0),)

    def __post_init__(self) -> None:
        if self.frames < 1 or not self.spacing_m > 0:
            raise SemvizError("a street needs at least 1 frame and a positive spacing")
        if not self.sections or any(not one.length_m > 0 for one in self.sections):
            raise SemvizError("a street needs at least 1 section, each of positive length")

    @property
    def length_m(self) -> float:
        """From the first to the last camera."""
        return (self.frames - 1) * self.spacing_m


@dataclass(frozen=True, eq=False)
class Layout:
    """Everything on a street."""

    road: Road
    sun: FloatArray
    """(3,) unit vector towards the sun."""
    poles: tuple[Pole, ...]
    signs: tuple[Sign, ...]
    cars: tuple[Car, ...]
    trees: tuple[Tree, ...]
    hedges: tuple[Hedge, ...]
    houses: tuple[House, ...]

    @cached_property
    def standing(self) -> tuple[tuple[Standing, ...], FloatArray]:
        """The n cars, poles and signs, and where each stands: (n, 4, 2) corners on the ground."""
        things: tuple[Standing, ...] = (*self.cars, *self.poles, *self.signs)
        corners = [one.corners_m[:, :2] for one in self.cars]
        corners += [np.tile(one.bottom_m[:2], (4, 1)) for one in self.poles]
        corners += [np.tile(one.middle_m[:2], (4, 1)) for one in self.signs]
        return things, np.array(corners).reshape(-1, 4, 2)


def lay_out(seed: int, options: StreetOptions) -> Layout:
    """The street of this seed."""
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
    return builder.layout()


def _stretches(options: StreetOptions) -> list[tuple[SectionKind, float, float]]:
    """(kind, begin, end) along the road; the first and the last reach to the street's ends."""
    ends = np.cumsum([one.length_m for one in options.sections])
    ends[-1] = max(float(ends[-1]), options.length_m + AHEAD_M)
    begins = np.concatenate([[-BEHIND_M], ends[:-1]])
    kinds = [one.kind for one in options.sections]
    return [
        (kind, float(begin), float(end))
        for kind, begin, end in zip(kinds, begins, ends, strict=True)
    ]


@dataclass
class _Builder:
    """Puts things beside a road, in the order of the random numbers."""

    road: Road
    rng: np.random.Generator
    poles: list[tuple[float, Pole, Sign | None]] = field(default_factory=list)
    cars: list[Car] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)
    hedges: list[Hedge] = field(default_factory=list)
    houses: list[House] = field(default_factory=list)

    def layout(self) -> Layout:
        """With the elements numbered along the road, from 1."""
        poles: list[Pole] = []
        signs: list[Sign] = []
        number = 0
        for _, pole, sign in sorted(self.poles, key=lambda one: one[0]):
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
        """Behind the camera and to one side, so that what it sees is lit."""
        azimuth = float(self.road.heading(0.0)) + np.pi
        azimuth += self.rng.choice([-1.0, 1.0]) * self.rng.uniform(0.7, 1.2)
        elevation = self.rng.uniform(0.65, 0.9)
        level = np.cos(elevation)
        return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])

    def furnish(self, kind: SectionKind, begin: float, end: float) -> None:
        """Poles and their signs."""
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
        peak = bottom + ROW_HEIGHT_M * UP
        pole = Pole(0, "post", bottom, peak, 0.05, _METAL[0], np.zeros(3))
        self.poles.append((s + 0.01 * side, pole, None))

    def _pole(self, s: float, side: int, sign: bool) -> None:
        kinds: tuple[PoleKind, ...] = ("post", "lamp", "mast")
        kind = kinds[self.rng.choice(3, p=(0.4, 0.4, 0.2))]
        reach = {"post": (0.35, 0.7), "lamp": (0.35, 0.6), "mast": (0.4, 2.3)}[kind]
        height = self.rng.uniform(*{"post": (2.2, 3.3), "lamp": (4.0, 8.0), "mast": (3, 5)}[kind])
        radius = {"post": 0.038, "lamp": 0.05 + 0.005 * height, "mast": 0.065}[kind]
        bottom = self.road.at(s, side * (KERB_M + self.rng.uniform(*reach)), KERB_HEIGHT_M)
        axis = UP + np.append(self.rng.normal(0.0, TILT_RAD, 2), 0.0)
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
            arm = -side * self.rng.uniform(1.0, 1.9) * self.road.left(s) + 0.2 * UP
        pole = Pole(0, kind, bottom, bottom + height * axis, radius, color, arm)
        self.poles.append((s + 0.01 * side, pole, plate))

    def _sign(
        self, s: float, bottom: FloatArray, axis: FloatArray, radius: float
    ) -> tuple[Sign, float]:
        """A sign in front of a pole, and the pole's height at which it ends."""
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
        sign = Sign(0, class_id, middle, half[0] * right, half[1] * UP, face, 0)
        return sign, height + float(half[1]) + 0.07  # the pole's peak stays in sight

    def park_cars(self, kind: SectionKind, side: int, begin: float, end: float) -> None:
        """Cars in the parking lane; none beside a row, whose poles must look alike."""
        share = {"normal": 0.24, "sparse": 0.2, "row": 0.0}[kind]
        for s in np.arange(begin + 3.5, end - 3.0, 6.4):
            if self.rng.random() > share:
                continue
            place = s + self.rng.uniform(-0.5, 0.5)
            d = side * (LANE_M + PARKING_M / 2 + self.rng.uniform(-0.1, 0.15))
            turn = np.pi if side > 0 else 0.0
            self.cars.append(
                Car(
                    middle_m=self.road.at(place, d),
                    heading_rad=float(self.road.heading(place)) + turn + self.rng.normal(0, 0.02),
                    scale=tuple(self.rng.uniform((0.88, 0.96, 0.95), (1.04, 1.02, 1.12))),
                    hatchback=bool(self.rng.random() < 0.6),
                    color=_PAINT[self.rng.integers(len(_PAINT))],
                )
            )

    def border(self, kind: SectionKind, side: int, begin: float, end: float) -> None:
        """Houses, gardens and meadows behind the pavement, plot by plot."""
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
            House(
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
                Hedge(
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
                Tree(
                    root_m=self.road.at(place, d, KERB_HEIGHT_M),
                    trunk_m=0.0 if bush else self.rng.uniform(1.6, 2.4),
                    crown_m=(4.2 * size, (3.0 if bush else 5.0) * size),
                    sprite=int(self.rng.integers(1 << 16)),
                    across_m=self.road.left(place),
                )
            )

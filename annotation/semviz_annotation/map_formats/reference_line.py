"""OpenDRIVE reference lines: the position at s along and t beside a road.

ASAM OpenDRIVE 1.8, chapters 8 (geometry), 9 (road reference line), 10.5 (elevation).
"""

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from semviz_annotation.label_formats.reading import quoted
from semviz_annotation.map_formats.conversion import attribute
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_PANEL_RAD = 0.5
"""Largest turn of one integration panel: 16 nodes are then exact to all digits."""
_MOST_PANELS = 10_000
_STEPS = 50
BEYOND_M = 0.01
"""Tolerance beyond the ends of a road, as files round."""


class Shape(Protocol):
    """A piece of a line that starts along u at the origin, or close to it."""

    def at(self, along_m: float) -> tuple[float, float, float]:
        """Return u, v (m) and the direction (rad) at arc length ``along_m``."""
        ...


@dataclass(frozen=True)
class Bend:
    """Line, arc or spiral: a curve whose curvature changes linearly."""

    curvature: float
    """1/m at the start."""
    rate: float = 0.0
    """Change of curvature, 1/m^2."""

    def at(self, along_m: float) -> tuple[float, float, float]:
        turn = abs(self.curvature * along_m) + 0.5 * abs(self.rate) * along_m**2
        panels = 1 + int(min(turn / _PANEL_RAD, _MOST_PANELS))
        if panels > _MOST_PANELS:
            raise SemvizError(f"a road that turns by {turn:g} rad")
        s, weights = _quadrature(along_m, panels)
        angle = s * (self.curvature + 0.5 * self.rate * s)
        end = along_m * (self.curvature + 0.5 * self.rate * along_m)
        return float(weights @ np.cos(angle)), float(weights @ np.sin(angle)), end


@dataclass(frozen=True, eq=False)
class Poly3:
    """v as a cubic of u."""

    v: FloatArray
    """(4,) from the constant up."""

    def at(self, along_m: float) -> tuple[float, float, float]:
        """Solve the arc length for u by Newton's method."""
        slopes = self.v[1:] * [1.0, 2.0, 3.0]
        u = along_m
        for _ in range(_STEPS):
            nodes, weights = _quadrature(u, 8)
            speed = np.hypot(1.0, _poly(slopes, nodes))
            u -= float((weights @ speed - along_m) / np.hypot(1.0, _poly(slopes, u)))
        return u, float(_poly(self.v, u)), float(np.arctan(_poly(slopes, u)))


@dataclass(frozen=True, eq=False)
class ParamPoly3:
    """u and v as cubics of a parameter proportional to s."""

    u: FloatArray
    v: FloatArray
    """(4,) from the constant up."""
    per_metre: float
    """Parameter per metre: 1, or 1 / length."""

    def at(self, along_m: float) -> tuple[float, float, float]:
        p = along_m * self.per_metre
        du, dv = (_poly(cubic[1:] * [1.0, 2.0, 3.0], p) for cubic in (self.u, self.v))
        return float(_poly(self.u, p)), float(_poly(self.v, p)), float(np.arctan2(dv, du))


@dataclass(frozen=True, eq=False)
class Profile:
    """A quantity along the road: a cubic from each start on."""

    starts_m: tuple[float, ...]
    cubics: tuple[FloatArray, ...]

    @classmethod
    def of(cls, elements: "list[Element]") -> "Profile":
        cubics = sorted((attribute(element, "s"), tuple(_cubic(element))) for element in elements)
        return cls(
            tuple(s for s, _ in cubics), tuple(np.array(coefficients) for _, coefficients in cubics)
        )

    def at(self, s: float) -> float:
        """Return the value at ``s``; 0 before the first start."""
        row = bisect_right(self.starts_m, s) - 1
        return float(_poly(self.cubics[row], s - self.starts_m[row])) if row >= 0 else 0.0


@dataclass(frozen=True)
class RoadPose:
    """A position beside the reference line, with the axes in which objects stand."""

    point_m: FloatArray
    """(3,) on the surface of the road, or its continuation."""
    heading_rad: float
    """Direction of the line at s, from x towards y."""


@dataclass(frozen=True, eq=False)
class RoadLine:
    """The reference line of one road with its heights."""

    length_m: float
    pieces: tuple[tuple[float, FloatArray, float, Shape], ...]
    """Start s, start (x, y), heading there, shape; by s."""
    elevation: Profile
    superelevation: Profile

    @classmethod
    def of(cls, road: "Element") -> "RoadLine":
        pieces = [_piece(geometry) for geometry in road.iterfind("planView/geometry")]
        if not pieces:
            raise SemvizError("a road without geometry")
        return cls(
            attribute(road, "length"),
            tuple(sorted(pieces, key=lambda piece: piece[0])),
            Profile.of(road.findall("elevationProfile/elevation")),
            Profile.of(road.findall("lateralProfile/superelevation")),
        )

    def place(self, s: float, t: float) -> RoadPose | None:
        """Return the pose at (s, t); None before or beyond the road."""
        if not -BEYOND_M <= s <= self.length_m + BEYOND_M:
            return None
        row = bisect_right(self.pieces, s, key=lambda piece: piece[0]) - 1
        start_s, start, heading, shape = self.pieces[max(row, 0)]
        u, v, turn = shape.at(s - start_s)
        c, sn = np.cos(heading), np.sin(heading)
        line = start + np.array([u * c - v * sn, u * sn + v * c])
        heading += turn
        tilt = self.superelevation.at(s)
        left = np.array([-np.sin(heading), np.cos(heading)])
        x, y = line + t * np.cos(tilt) * left
        return RoadPose(np.array([x, y, self.elevation.at(s) + t * np.sin(tilt)]), heading)


def _piece(geometry: "Element") -> tuple[float, FloatArray, float, Shape]:
    start = np.array([attribute(geometry, "x"), attribute(geometry, "y")])
    length_m = attribute(geometry, "length")
    shape = next((_shape(child, length_m) for child in geometry if child.tag != "userData"), None)
    if shape is None:
        raise SemvizError("a geometry without a shape")
    return attribute(geometry, "s"), start, attribute(geometry, "hdg"), shape


def _shape(element: "Element", length_m: float) -> Shape:
    match element.tag:
        case "line":
            return Bend(0.0)
        case "arc":
            return Bend(attribute(element, "curvature"))
        case "spiral":
            first, last = attribute(element, "curvStart"), attribute(element, "curvEnd")
            return Bend(first, (last - first) / _positive(length_m))
        case "poly3":
            return Poly3(_cubic(element))
        case "paramPoly3":
            along = element.get("pRange", "normalized") == "arcLength"
            per_metre = 1.0 if along else 1.0 / _positive(length_m)
            return ParamPoly3(_cubic(element, "U"), _cubic(element, "V"), per_metre)
    raise SemvizError(f"a geometry of an unknown shape, {quoted(element.tag)}")


def _positive(length_m: float) -> float:
    if not length_m > 0.0:
        raise SemvizError(f"a geometry of length {length_m:g}")
    return length_m


def _cubic(element: "Element", of: str = "") -> FloatArray:
    """Return the coefficients a, b, c, d (4,)."""
    return np.array([attribute(element, f"{name}{of}") for name in "abcd"])


def _poly(coefficients: FloatArray, x: FloatArray | float) -> FloatArray | float:
    value: FloatArray | float = 0.0
    for coefficient in coefficients[::-1]:
        value = value * x + coefficient
    return value


def _quadrature(length_m: float, panels: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights over [0, length_m] (Gauss-Legendre in equal panels)."""
    half = 0.5 * length_m / panels
    middles = half * (2.0 * np.arange(panels) + 1.0)
    return (middles[:, None] + half * _NODES).ravel(), np.tile(half * _WEIGHTS, panels)

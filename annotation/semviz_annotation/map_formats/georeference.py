"""Between a map's own metres and WGS84: latitude, longitude, height above the ellipsoid."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import MapFrame

if TYPE_CHECKING:
    from pyproj import Transformer

FURTHEST_M = 100_000.0
"""A map reaches no further from its origin: what does is somewhere else, or swapped."""


@dataclass(frozen=True)
class Georeference:
    """Where a map's origin is on the ellipsoid, and which way its x axis points there.

    The map's axes are those of the tangent plane at the origin: z is up there, y is to the left
    of x. x points east and y north unless ``x_heading_deg``, a compass direction, says otherwise.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    x_heading_deg: float = 90.0

    def __post_init__(self) -> None:
        for name, value, most in (
            ("latitude", self.latitude_deg, 90.0),
            ("longitude", self.longitude_deg, 180.0),
            ("height", self.height_m, FURTHEST_M),
            ("heading", self.x_heading_deg, 360.0),
        ):
            if not abs(value) <= most:
                raise SemvizError(
                    f"anchor: {name} {value:g} is not within {-most:g} and {most:g}; "
                    "give WGS84 latitude, longitude (degrees) and height (m)"
                )

    @classmethod
    def of(cls, frame: MapFrame) -> "Georeference | None":
        """What a map frame knows; None where it does not know its origin."""
        return None if frame.origin is None else cls(*frame.origin, frame.x_heading_deg)

    @property
    def origin(self) -> tuple[float, float, float]:
        """As ``MapFrame.origin``."""
        return (self.latitude_deg, self.longitude_deg, self.height_m)

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) R_enu_map: from the map's axes to east, north and up at the origin."""
        if self.x_heading_deg == 90.0:
            return np.eye(3)
        heading = np.deg2rad(self.x_heading_deg)
        s, c = np.sin(heading), np.cos(heading)
        return np.array([[s, -c, 0.0], [c, s, 0.0], [0.0, 0.0, 1.0]])

    def to_wgs84(self, points_m: FloatArray) -> FloatArray:
        """(n, 3) longitude, latitude (deg) and height (m), in GeoJSON's order, of map points."""
        enu = points_m @ self.rotation.T
        x, y, z = enu.T
        return np.column_stack(self._topocentric.transform(x, y, z, direction="INVERSE"))

    def to_map(self, places: FloatArray) -> FloatArray:
        """(n, 3) map points of longitude, latitude, height (n, 3).

        Raises SemvizError where they are no WGS84, or far from the origin.
        """
        outside = ~(np.abs(places[:, :2]) <= [180.0, 90.0]).all(axis=1)
        if outside.any():
            longitude, latitude = places[outside][0, :2]
            raise SemvizError(
                f"longitude {longitude:g}, latitude {latitude:g} are no degrees of WGS84; "
                "convert the file to EPSG:4326 first"
            )
        enu = np.column_stack(self._topocentric.transform(*places.T))
        distances_m = np.linalg.norm(enu, axis=1)
        if not (distances_m <= FURTHEST_M).all():
            raise SemvizError(
                f"a point is {distances_m.max() / 1000:.0f} km from the map's origin "
                f"({self.latitude_deg:g}, {self.longitude_deg:g}); are latitude and longitude "
                "swapped, or is --anchor elsewhere?"
            )
        return np.asarray(enu @ self.rotation)

    @cached_property
    def _topocentric(self) -> "Transformer":
        """Degrees and metres of WGS84 -> east, north, up (EPSG method 9837)."""
        from pyproj import Transformer

        latitude, longitude, height = self.origin
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}"
        )


def needed(georeference: Georeference | None, why: str) -> Georeference:
    """SemvizError where the place of the map on Earth is not known."""
    if georeference is None:
        raise SemvizError(
            f"{why}, and where the map's origin is on Earth is not known; "
            "say --anchor LATITUDE,LONGITUDE[,HEIGHT]"
        )
    return georeference

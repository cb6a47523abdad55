"""Conversion between map metres and WGS84: latitude, longitude, height above the ellipsoid."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from pyproj import Transformer

MOST_MISFIT_M = 0.5
"""Disagreement of two coordinates of one point: a grid's scale errs by 0.4 m in a kilometre."""
FURTHEST_M = 100_000.0
"""Largest extent of a map: farther points are misplaced, or have swapped coordinates."""


@dataclass(frozen=True)
class Georeference:
    """Position of a map's origin on the ellipsoid, and the heading of its x axis.

    The map's axes are those of the tangent plane at the origin: z is up, y is to the left of x.
    ``x_heading_deg`` is the compass direction of x; by default x points east.
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
        """Return the georeference of a map frame; None if its origin is not known."""
        return None if frame.origin is None else cls(*frame.origin, frame.x_heading_deg)

    @property
    def origin(self) -> tuple[float, float, float]:
        """Latitude, longitude (deg) and height (m), as in ``MapFrame.origin``."""
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
        """Return longitude, latitude (deg) and height (m), (n, 3), of map points (n, 3)."""
        enu = points_m @ self.rotation.T
        x, y, z = enu.T
        return np.column_stack(self._topocentric.transform(x, y, z, direction="INVERSE"))

    def to_map(self, places: FloatArray) -> FloatArray:
        """Return map points (n, 3) of longitudes, latitudes and heights (n, 3).

        Raise SemvizError if they are not WGS84, or too far from the origin.
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


def fitted_georeference(points_m: FloatArray, places: FloatArray) -> Georeference | None:
    """Return where a map is on Earth, from points (n, 3) in it and their places (n, 3).

    None if they do not agree within ``MOST_MISFIT_M``: the map is in a projection, or far from its
    origin.
    """
    if len(points_m) < 2:
        return None
    longitude, latitude, height = places[0].tolist()
    found = Georeference(latitude, longitude, height)
    middle = points_m.mean(axis=0)
    for _ in range(3):  # the tangent plane moves with the origin
        enu = Georeference(*found.origin).to_map(places)
        across = (points_m - middle)[:, :2].T @ (enu - enu.mean(axis=0))[:, :2]
        turn = float(np.arctan2(across[0, 1] - across[1, 0], np.trace(across)))
        found = Georeference(*found.origin, float(np.rad2deg(np.pi / 2.0 - turn) % 360.0))
        shift = enu.mean(axis=0) - found.rotation @ middle
        longitude, latitude, height = Georeference(*found.origin).to_wgs84(shift[None])[0].tolist()
        found = Georeference(latitude, longitude, height, found.x_heading_deg)
    misfit_m = np.linalg.norm(found.to_map(places) - points_m, axis=1)
    return found if misfit_m.max() <= MOST_MISFIT_M else None


def require_georeference(georeference: Georeference | None, why: str) -> Georeference:
    """Return ``georeference``. Raise SemvizError if it is None."""
    if georeference is None:
        raise SemvizError(
            f"{why}, and where the map's origin is on Earth is not known; "
            "say --anchor LATITUDE,LONGITUDE[,HEIGHT]"
        )
    return georeference

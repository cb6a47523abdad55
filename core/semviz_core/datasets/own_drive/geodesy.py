"""Positions on the WGS84 ellipsoid in metres: earth-centred, and local east, north and up."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray

if TYPE_CHECKING:
    from pyproj import Transformer

_RADII_M = (6.33e6, 6.41e6)
"""From the earth's centre to its surface, with a margin."""


@cache
def _to_ecef() -> "Transformer":
    """Return the transformation of longitude, latitude and height to ECEF, on WGS84."""
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def earth_centred(
    latitude_rad: FloatArray, longitude_rad: FloatArray, h_m: FloatArray
) -> FloatArray:
    """Return ECEF positions (n, 3), m, of geodetic ones (n,); ``h_m`` is above the ellipsoid."""
    return np.column_stack(_to_ecef().transform(longitude_rad, latitude_rad, h_m, radians=True))


def is_earth_centred(positions_m: FloatArray) -> bool:
    """Whether positions (n, 3) are as far from their origin as the earth's surface."""
    radii = np.linalg.norm(positions_m, axis=1)
    return bool(((radii > _RADII_M[0]) & (radii < _RADII_M[1])).all())


def geodetic(position_m: FloatArray) -> tuple[float, float, float]:
    """Return latitude, longitude (deg) and height above the ellipsoid (m) of an ECEF position."""
    x, y, z = position_m.tolist()
    longitude, latitude, height_m = _to_ecef().transform(x, y, z, direction="INVERSE")
    return float(latitude), float(longitude), float(height_m)


def east_north_up(position_m: FloatArray) -> Pose:
    """Return T_enu_ecef of the local frame whose origin is an ECEF position (3,)."""
    x, y, z = position_m.tolist()
    longitude, latitude, _ = _to_ecef().transform(x, y, z, radians=True, direction="INVERSE")
    R = axes_at(latitude, longitude)
    return Pose(R, -R @ position_m)


def map_on_earth(origin: tuple[float, float, float], x_heading_deg: float) -> Pose:
    """Return T_map_ecef of a map, by latitude, longitude (deg) and height (m) of its origin.

    ``x_heading_deg`` is the compass direction of the map's x axis; its z axis is up.
    """
    latitude, longitude, height_m = (np.array([value]) for value in origin)
    place = earth_centred(np.deg2rad(latitude), np.deg2rad(longitude), height_m)[0]
    turn = np.deg2rad(x_heading_deg - 90.0)  # clockwise from east
    R_map_enu = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    return Pose(R_map_enu, np.zeros(3)) @ east_north_up(place)


def axes_at(latitude_rad: float, longitude_rad: float) -> FloatArray:
    """Return (3, 3) from ECEF axes to east, north and up at a place."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_lon, cos_lon = np.sin(longitude_rad), np.cos(longitude_rad)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def local_poses(
    latitude_deg: FloatArray, longitude_deg: FloatArray, h_m: FloatArray, R_enu_body: FloatArray
) -> FloatArray:
    """Return (n, 3, 4) poses in east-north-up at the first place, of bodies there.

    ``R_enu_body`` (n, 3, 3) are to east, north and up at each own place.
    """
    latitude, longitude = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    positions = earth_centred(latitude, longitude, h_m)
    R_first = axes_at(float(latitude[0]), float(longitude[0]))
    R_own = np.array([axes_at(*place) for place in zip(latitude, longitude, strict=True)])
    t = (positions - positions[0]) @ R_first.T
    return np.concatenate([R_first @ R_own.transpose(0, 2, 1) @ R_enu_body, t[:, :, None]], axis=2)

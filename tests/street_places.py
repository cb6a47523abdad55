"""Where on earth a simulated street lies; computed by PROJ."""

from functools import cache
from typing import Any

from semviz_core.common.arrays import FloatArray

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 49.0, 8.4, 115.0


@cache
def _to_geodetic() -> Any:
    from pyproj import Transformer

    return Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={LATITUDE_DEG} "
        f"+lon_0={LONGITUDE_DEG} +h_0={HEIGHT_M} +step +inv +proj=cart +ellps=WGS84"
    )


def geodetic(place_m: FloatArray) -> tuple[float, float, float]:
    """Return latitude, longitude (deg) and height (m) of a place (3,) east, north and up."""
    longitude, latitude, height = _to_geodetic().transform(*place_m.tolist())
    return float(latitude), float(longitude), float(height)

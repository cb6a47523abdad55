"""Small texts that options are written in."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz_annotation.map_formats.georeference import Georeference

OptionalPath = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]
OptionalText = Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="")]
OptionalInt = Annotated[int | None, arg(metavar="INT", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint="")]


def parse_frames(text: str | None) -> range | None:
    """``0:20`` or ``0:20:2`` (numbers as in file names, end excluded); None for all."""
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(":")]
        first, end, step = (*numbers, 1)[:3] if len(numbers) in (2, 3) else (0, 0, 0)
        frames = range(first, end, step)
    except ValueError:
        frames = range(0)
    if not frames:
        raise SemvizError(f"--frames {text}: write FIRST:END or FIRST:END:STEP, such as 0:20:2")
    return frames


def parse_cameras(text: str) -> tuple[int, ...]:
    """``2,3`` (left, right) or ``2``."""
    try:
        cameras = tuple(int(part) for part in text.split(","))
    except ValueError:
        cameras = ()
    if len(cameras) not in (1, 2):
        raise SemvizError(f"--cameras {text}: write LEFT,RIGHT, such as 2,3, or one camera")
    return cameras


def parse_interval(text: str, option: str) -> tuple[float, float]:
    """``5:10`` as two numbers, the first not above the second."""
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        low, high = 1.0, 0.0
    if not 0.0 <= low <= high:
        raise SemvizError(f"{option} {text}: write LOW:HIGH in metres, such as 5:10")
    return low, high


def parse_anchor(text: str | None, x_heading_deg: float | None) -> "Georeference | None":
    """``49.0,8.4,115``: WGS84 latitude, longitude and, if known, height of a map's origin.

    ``x_heading_deg`` is the compass direction of its x axis there, east if None.
    """
    from semviz_annotation.map_formats.georeference import Georeference

    if text is None:
        if x_heading_deg is not None:
            raise SemvizError("--anchor-heading: say --anchor LATITUDE,LONGITUDE[,HEIGHT] too")
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise SemvizError(f"--anchor {text}: write LATITUDE,LONGITUDE[,HEIGHT], such as 49.0,8.4")
    latitude, longitude, height = (*numbers, 0.0)[:3]
    heading = 90.0 if x_heading_deg is None else x_heading_deg
    return Georeference(latitude, longitude, height, heading)

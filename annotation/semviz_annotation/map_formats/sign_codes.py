"""The shape of a traffic sign by country and number; the paper's classes are shapes.

Numbers follow each country's catalogue: Germany's StVO and VzKat (``de205``, ``de274.1``),
Sweden's Vägmärkesförordning by groups (``sea``, ``seb-4``). An octagon counts as rounded, a
diamond as rectangular. Crosses and numbers with several shapes are left out.
"""

from collections.abc import Iterator, Mapping

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR

_GERMAN: tuple[tuple[range, int], ...] = (
    (range(101, 152), TRIANGULAR),  # danger
    (range(156, 163), RECTANGULAR),  # beacons before a level crossing
    (range(205, 206), TRIANGULAR),  # give way
    (range(206, 216), ROUNDED),  # stop (octagon), prescribed directions, roundabout
    (range(220, 221), RECTANGULAR),  # one-way road
    (range(222, 223), ROUNDED),
    (range(223, 224), RECTANGULAR),
    (range(224, 225), ROUNDED),  # stop of buses or trams
    (range(229, 230), RECTANGULAR),
    (range(237, 242), ROUNDED),
    (range(242, 245), RECTANGULAR),  # zones
    (range(245, 287), ROUNDED),  # bans, speed limits
    (range(290, 291), RECTANGULAR),
    (range(301, 302), TRIANGULAR),  # priority at the next crossing
    (range(306, 460), RECTANGULAR),  # priority road (diamond), information, directions
    (range(501, 552), RECTANGULAR),
    (range(605, 606), RECTANGULAR),
    (range(625, 627), RECTANGULAR),  # chevrons
    (range(1000, 1100), RECTANGULAR),  # plates below signs
)
_GERMAN_ZONES = ("270.1", "270.2", "274.1", "274.2", "290.1", "290.2")
"""Round signs on square plates."""
_SWEDISH: Mapping[str, int] = {
    "a": TRIANGULAR,
    "b-1": TRIANGULAR,
    "b-2": ROUNDED,
    "b-3": RECTANGULAR,
    "b-4": RECTANGULAR,
    "c": ROUNDED,
    "d": ROUNDED,
    "e": RECTANGULAR,
    "f": RECTANGULAR,
    "g": RECTANGULAR,
    "h": RECTANGULAR,
    "i": RECTANGULAR,
}


def _entries() -> Iterator[tuple[str, int]]:
    for numbers, class_id in _GERMAN:
        yield from ((f"de{number}", class_id) for number in numbers)
    yield from ((f"de{number}", RECTANGULAR) for number in _GERMAN_ZONES)
    yield from ((f"se{group}", class_id) for group, class_id in _SWEDISH.items())


SIGN_CODES: Mapping[str, int] = dict(_entries())
"""Code -> class id."""


def codes_of(country: str, kind: str, subtype: str) -> list[str]:
    """Codes that a signal of OpenDRIVE may be known by, the exact one first."""
    code = f"{country}{kind}".lower()
    has_subtype = subtype not in ("", "-1", "none")
    return [f"{code}-{subtype}".lower(), code] if has_subtype else [code]

"""The class of an element by its name in maps: signs by country and number, OpenStreetMap's tags.

Classes of signs are shapes. Numbers follow each country's catalogue: Germany's StVO and VzKat
(``de205``, ``de274.1``), Sweden's Vägmärkesförordning by groups (``sea``, ``seb-4``), the MUTCD of
the USA by series (``usr1-1``). An octagon counts as rounded, a diamond as rectangular. Crosses and
numbers with several shapes are left out.
"""

from collections.abc import Iterator, Mapping

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR

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

_AMERICAN: Mapping[str, int] = {
    "r1-1": ROUNDED,  # stop (octagon)
    "r1-2": TRIANGULAR,  # yield
    "r": RECTANGULAR,
    "w": RECTANGULAR,  # warnings are diamonds
    "d": RECTANGULAR,
    "i": RECTANGULAR,
    "m": RECTANGULAR,
    "s": RECTANGULAR,
}
_NAMED: Mapping[str, int] = {
    "stop": ROUNDED,
    "stop_sign": ROUNDED,
    "give_way": TRIANGULAR,
    "give_way_sign": TRIANGULAR,
    "yield": TRIANGULAR,
    "yield_sign": TRIANGULAR,
    "hazard": TRIANGULAR,
    "maxspeed": ROUNDED,
    "speed_limit": ROUNDED,
    "overtaking": ROUNDED,
    "no_overtaking": ROUNDED,
    "city_limit": RECTANGULAR,
    "priority_road": RECTANGULAR,
    "direction_sign": RECTANGULAR,
    "right_of_way": RECTANGULAR,
}
"""Names of subtypes in Lanelet2 and Autoware, and values of OpenStreetMap's ``traffic_sign``."""
OSM_TAGS: Mapping[tuple[str, str], int] = {
    ("highway", "street_lamp"): POLE,
    ("power", "pole"): POLE,
    ("telecom", "pole"): POLE,
    ("man_made", "utility_pole"): POLE,
    ("man_made", "flagpole"): POLE,
}
"""Tags of OpenStreetMap's nodes that are poles; ``traffic_sign`` has a code of its own."""
_COUNTRIES = {
    "de": "deu germany deutschland 276",
    "se": "swe sweden sverige 752",
    "us": "usa united_states united_states_of_america 840",
}
"""Countries with a catalogue, by ISO 3166's two letters: other codes and names of them."""
_LIKE_GERMANY = ("opendrive", "", "-1", "none", "unknown")
"""OpenDRIVE's own numbers, and those of files without a country, are the German ones."""


def is_like_germany(country: str) -> bool:
    """Whether signs of a file's country are numbered as in Germany because it states none."""
    return country.strip().lower() in _LIKE_GERMANY


def country_code(country: str) -> str:
    """Return the two letters of a country with a catalogue; any other name in small letters."""
    plain = country.strip().lower().replace(" ", "_")
    if is_like_germany(country):
        return "de"
    return next((two for two, names in _COUNTRIES.items() if plain in names.split()), plain)


def osm_codes(tags: Mapping[str, str]) -> list[str]:
    """Return the codes that OpenStreetMap's ``traffic_sign`` may be known by, the exact one first.

    ``DE:274[50],1040`` is a sign with a plate below; the first one counts.
    """
    whole = tags.get("traffic_sign", "")
    first = whole.replace(";", ",").split(",")[0].strip()
    country, colon, number = first.partition(":")
    if not colon:
        return [whole, first, first.lower()]
    plain = number.partition("[")[0].lower().replace("_", ".")
    code = f"{country_code(country)}{plain}"
    return [whole, first, code, code.partition("-")[0], code[:3]]


def _entries() -> Iterator[tuple[str, int]]:
    for numbers, class_id in _GERMAN:
        yield from ((f"de{number}", class_id) for number in numbers)
    yield from ((f"de{number}", RECTANGULAR) for number in _GERMAN_ZONES)
    yield from ((f"se{group}", class_id) for group, class_id in _SWEDISH.items())
    yield from ((f"us{series}", class_id) for series, class_id in _AMERICAN.items())
    yield from _NAMED.items()


SIGN_CODES: Mapping[str, int] = dict(_entries())
"""Code -> class id."""


def codes_of(country: str, kind: str, subtype: str) -> list[str]:
    """Codes that a signal of OpenDRIVE may be known by, the exact one first.

    A country may be named by ISO 3166's two or three letters, or in full.
    """
    given = [f"{country}{kind}".lower(), f"{country_code(country)}{kind}".lower()]
    codes = list(dict.fromkeys(given))
    has_subtype = subtype not in ("", "-1", "none")
    exact = [f"{code}-{subtype}".lower() for code in codes] if has_subtype else []
    return [*exact, *codes]

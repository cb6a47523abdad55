"""The class of an element by its name in maps: signs by country and number, OpenStreetMap's tags.

Classes of signs are shapes: T triangular, Q rectangular, O rounded, - none of these. An octagon
counts as rounded, a diamond as rectangular. Numbers with several shapes are left out. Numbers
follow each country's catalogue; a group stands for its numbers, and the longest entry that a number
starts with counts. A country without a catalogue is read by the letters of the Vienna Convention on
Road Signs (annex 1), which the report says.
"""

import re
from collections.abc import Iterator, Mapping

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR

_SHAPES = {"T": TRIANGULAR, "Q": RECTANGULAR, "O": ROUNDED, "-": None}
VIENNA = "vienna"
_CATALOGUES: Mapping[str, str] = {
    # Danger; beacons; give way; stop (octagon), directions; one-way road; stops of buses; zones;
    # bans; priority; information, directions (340 to 342 are markings); chevrons; plates.
    "de": "101-151:T 156-162:Q 205:T 206-215:O 220:Q 222:O 223:Q 224:O 229:Q 237-241:O 242-244:Q "
    "245-286:O 290:Q 301:T 306-339:Q 350-459:Q 501-551:Q 605:Q 625-626:Q 1000-1099:Q "
    "270.1:Q 270.2:Q 274.1:Q 274.2:Q 290.1:Q 290.2:Q",  # the last: round signs on square plates
    "at": "50:T 52:O 52.11:Q 52.23:T 52.25:Q 53:Q 54:Q",
    "be": "a:T b1:T b3:T b5:O b9:Q b11:Q b15:T b17:T b19:O b21:Q c:O d:O e1:O e3:O e5:O e7:O e9:Q "
    "f:Q",
    "br": "r:O r1:O r2:T a:Q",
    "ca": "ra1:O ra2:T rb:Q w:Q",
    "ch": "1:T 1.17:Q 1.22:- 2:O 2.59:Q 3.01:O 3.02:T 3.03:Q 3.04:Q 3.05:T 3.06:T 3.09:O "
    "3.10:Q 4:Q 5:Q",
    "cz": "a:T b:O c:O e:Q ip:Q is:Q iz:Q p1:T p2:Q p3:Q p4:T p6:O p7:O p8:Q",
    "dk": "a:T b11:T b13:O b16:Q c:O d:O e:Q",
    "es": "p:T r:O r1:T r2:O r3:Q r4:Q r6:Q s:Q",
    "fi": "a:T b1:Q b2:Q b5:T b6:O c:O d:O e:Q f:Q g:Q h:Q",
    "fr": "a:T ab1:T ab2:T ab3:T ab4:O ab6:Q ab7:Q ab25:T b:O b30:Q b51:Q c:Q d:Q e:Q",
    "gb": "501-599:T 515:Q 601:O 602:T 606:O 609:O 610-629:O 632:O 636:O 642:O 652:Q "
    "670:O 701-999:Q",
    "jp": "201-215:Q 301-329:O 329:T 330:T",
    "nl": "a:O a4:Q a5:Q b1:Q b2:Q b3:T b4:T b5:T b6:T b7:O c:O c3:Q c4:Q d:O e1:O e2:O e3:O e4:Q "
    "j:T k:Q l:Q",
    "no": "100-136:T 142-156:T 202:T 204:O 206:Q 208:Q 210:T 212:O 214:Q 302-365:O 366-368:Q "
    "370-379:O 400-409:O 500-999:Q",
    "pl": "a:T b:O c:O d:Q e:Q f:Q t:Q",
    "ru": "1.1:T 1.2:T 1.5-1.33:T 2.1:Q 2.2:Q 2.3:T 2.4:T 2.5:O 2.6:O 2.7:Q 3:O 4:O 5:Q 6:Q "
    "7:Q 8:Q",
    "se": "a:T b1:T b2:O b3:Q b4:Q c:O d:O e:Q f:Q g:Q h:Q i:Q",
    "ua": "2.1:T 2.2:O 2.3:Q 2.4:Q 3:O 4:O 5:Q 6:Q 7:Q",
    "us": "r:Q r1-1:O r1-2:T w:Q d:Q i:Q m:Q s:Q",
    VIENNA: "a:T b1:T b2:O b3:Q b4:Q c:O d:O e:Q f:Q g:Q h:Q",
}
"""Shapes by country (ISO 3166, two letters): numbers, ranges of numbers, or groups."""
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
    "at": "aut austria osterreich 040",
    "be": "bel belgium belgie belgique 056",
    "br": "bra brazil brasil 076",
    "ca": "can canada 124",
    "ch": "che switzerland schweiz suisse svizzera 756",
    "cz": "cze czechia czech_republic 203",
    "de": "deu germany deutschland 276",
    "dk": "dnk denmark danmark 208",
    "es": "esp spain espana 724",
    "fi": "fin finland suomi 246",
    "fr": "fra france 250",
    "gb": "gbr uk united_kingdom great_britain england 826",
    "jp": "jpn japan 392",
    "nl": "nld netherlands the_netherlands nederland 528",
    "no": "nor norway norge 578",
    "pl": "pol poland polska 616",
    "ru": "rus russia russian_federation 643",
    "se": "swe sweden sverige 752",
    "ua": "ukr ukraine 804",
    "us": "usa united_states united_states_of_america 840",
}
"""Countries with a catalogue: other codes and names of them."""
_LIKE_GERMANY = ("opendrive", "", "-1", "none", "unknown")
"""OpenDRIVE's own numbers, and those of files without a country, are the German ones."""


def is_like_germany(country: str) -> bool:
    """Whether signs of a file's country are numbered as in Germany because it states none."""
    return country.strip().lower() in _LIKE_GERMANY


def country_code(country: str) -> str:
    """Return the two letters of a country with a catalogue; any other name in small letters."""
    plain = country.strip().lower().replace(" ", "_").translate(_PLAIN)
    if is_like_germany(country):
        return "de"
    return next((two for two, names in _COUNTRIES.items() if plain in names.split()), plain)


_PLAIN = str.maketrans("äöüéèñ", "aoueen")


def has_catalogue(country: str) -> bool:
    """Whether signs of a country are known by its own numbers."""
    return country_code(country) in _CATALOGUES


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
    return [whole, first, f"{country_code(country)}{plain}"]


def _entries() -> Iterator[tuple[str, int | None]]:
    for country, text in _CATALOGUES.items():
        for entry in text.split():
            numbers, _, shape = entry.partition(":")
            first, dash, last = numbers.partition("-")
            if dash and first.isdigit() and last.isdigit():
                names = [str(number) for number in range(int(first), int(last) + 1)]
            elif dash and re.fullmatch(r"1\.\d+", first):  # a range within a chapter
                names = [f"1.{number}" for number in range(int(first[2:]), int(last[2:]) + 1)]
            else:
                names = [numbers]
            yield from ((_normal(country + name), _SHAPES[shape]) for name in names)


def _normal(code: str) -> str:
    """Return a code without dashes and zeros between letters and numbers: ``seb-4``, ``nlb06``.

    Lanelet2 writes ``de274_1``, as ``.`` is rare in its tags.
    """
    return re.sub(r"(?<=[a-z])-?0*(?=\d)", "", code.lower().replace("_", "."))


_SIGNS: Mapping[str, int | None] = dict(_entries())
"""Code -> class id; None: of another shape."""


def sign_class(code: str) -> int | None:
    """Return the class of a sign by its name, or country and number; None if it is not known.

    ``de274-50`` is found as ``de274``, ``sec-31`` as ``sec``.
    """
    if code in _NAMED:
        return _NAMED[code]
    plain = _normal(code)
    starts = (plain[:end] for end in range(len(plain), 2, -1) if _is_whole(plain, end))
    return next((_SIGNS[start] for start in starts if start in _SIGNS), None)


def _is_whole(code: str, end: int) -> bool:
    """Whether a code may be cut here: not within letters, nor within digits."""
    before, after = code[end - 1], code[end : end + 1]
    return not (before.isalpha() and after.isalpha()) and not (before.isdigit() and after.isdigit())


def codes_of(country: str, kind: str, subtype: str) -> list[str]:
    """Codes that a signal of OpenDRIVE may be known by, the exact one first.

    A country may be named by ISO 3166's two or three letters, or in full.
    """
    given = [f"{country}{kind}".lower(), f"{country_code(country)}{kind}".lower()]
    codes = list(dict.fromkeys(given))
    has_subtype = subtype not in ("", "-1", "none")
    exact = [f"{code}-{subtype}".lower() for code in codes] if has_subtype else []
    return [*exact, *codes]

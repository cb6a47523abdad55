"""The golden set, as far as it is the same on all machines: stored data do not change.

``python -m golden check`` also compares the exact bits of computed values, and all wordings.
"""

from typing import Any

import pytest
from golden.maps import PLACES
from golden.runner import WORDS, differences, expected_of, golden_values

TOLERANCE_M = 1e-5
"""Map positions differ by less between machines and libraries of linear algebra."""
COMPUTED = {
    "G2": (),
    "G3": (),
    "G4": ("town", "lane", "mono"),
    "G9": ("map as colmap", "map from", "poses of workspace", "poses of run as"),
}
"""Prefixes of the keys whose last bits depend on the machine."""


@pytest.mark.parametrize("name", ["G2", "G3", "G9"])
def test_what_is_stored_is_the_same(name: str) -> None:
    expected, actual = expected_of(name), golden_values(name)
    assert list(differences(_portable(name, expected), _portable(name, actual))) == []


def test_maps_are_built_of_the_same_elements_in_the_same_places() -> None:
    expected, found = expected_of("G4"), golden_values("G4")
    exact = [_portable("G4", value) for value in (expected, found)]
    assert list(differences(*exact)) == []
    for name in (key for key in expected if key.startswith(PLACES)):
        for position, other in zip(expected[name], found[name], strict=True):
            assert position == pytest.approx(other, abs=TOLERANCE_M, nan_ok=True)


def _portable(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values without wordings and computed bits; of rerun's entities, only the names."""
    kept = {}
    for key, value in values.items():
        if key.startswith((WORDS, PLACES)) or (": " not in key and key.startswith(COMPUTED[name])):
            continue
        kept[key] = (
            {entity: names for entity, (names, _) in value.items()} if "stored" in key else value
        )
    return kept

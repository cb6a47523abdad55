"""What takes long to measure in an image is measured once, however many tests ask for it.

Many tests bring in one recording, each in another way; the checks of an import then look for the
same edges and corners in the same images.
"""

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from hashlib import blake2b
from typing import Any

import pytest

from semviz_core.datasets.own_drive.checks import line_checks, match_checks


def remembering(measure: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``measure`` with answers by the content of its arguments; each answer is a copy."""
    known: dict[bytes, bytes] = {}

    @wraps(measure)
    def remembered(*arguments: Any) -> Any:
        key = blake2b(pickle.dumps(arguments)).digest()
        if key not in known:
            known[key] = pickle.dumps(measure(*arguments))
        return pickle.loads(known[key])

    return remembered


@contextmanager
def images_measured_once() -> Iterator[None]:
    """Within it, imports of drives remember edges and matches."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((line_checks, "bent_edges"), (match_checks, "matched_pixels")):
            patch.setattr(module, name, remembering(getattr(module, name)))
        yield

"""Are two values of ours the same, to the last bit?"""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def assert_same(class_: Any, other: Any) -> None:
    """Equal to the last bit, types and dtypes included."""
    assert type(class_) is type(other)
    if is_dataclass(class_):
        for member in fields(class_):
            assert_same(getattr(class_, member.name), getattr(other, member.name))
    elif isinstance(class_, np.ndarray):
        assert (class_.dtype, class_.shape) == (other.dtype, other.shape)
        assert class_.tobytes() == other.tobytes()
    elif isinstance(class_, tuple):
        assert len(class_) == len(other)
        for a, b in zip(class_, other, strict=True):
            assert_same(a, b)
    elif isinstance(class_, float):
        assert np.float64(class_).tobytes() == np.float64(other).tobytes()
    elif isinstance(class_, dict):
        assert list(class_) == list(other)
        for key in class_:
            assert_same(class_[key], other[key])
    else:
        assert class_ == other

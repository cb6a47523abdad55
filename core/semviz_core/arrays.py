"""Checks for arrays where they enter the program."""

from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semviz_core.errors import SemvizError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
ByteImage: TypeAlias = NDArray[np.uint8]
"""(height, width, 3) sRGB, red first."""

LARGEST = 1e12
"""No coordinate, pixel or variance is larger; squares of larger ones would lose all digits."""

Array = TypeVar("Array", bound=NDArray[Any])


def float_array(
    value: ArrayLike, shape: tuple[int | None, ...], name: str, *, nan: bool = False
) -> FloatArray:
    """Return ``value`` as a read-only float64 array of ``shape`` (None: any length).

    Raises SemvizError naming ``name`` where the shape differs, or a number is infinite, beyond
    ``LARGEST`` or, unless ``nan``, not a number.
    """
    array = _shaped(_read(value, name, np.float64), shape, name)
    if np.isinf(array).any() or (not nan and np.isnan(array).any()):
        raise SemvizError(f"{name} holds NaN or infinite numbers; remove or repair those rows")
    if (np.abs(array) > LARGEST).any():
        raise SemvizError(f"{name} holds numbers beyond {LARGEST:g}; remove or repair those rows")
    return array


def int_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> IntArray:
    """Return ``value`` as a read-only int64 array of ``shape`` (None: any length)."""
    raw = _read(value, name)
    if raw.size and raw.dtype.kind not in "iu":
        raise SemvizError(f"{name} must hold whole numbers, not {raw.dtype}")
    return _shaped(raw.astype(np.int64, copy=False), shape, name)


def bool_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> BoolArray:
    """Return ``value`` as a read-only bool array of ``shape`` (None: any length)."""
    raw = _read(value, name)
    if raw.size and raw.dtype != np.bool_:
        raise SemvizError(f"{name} must hold true or false, not {raw.dtype}")
    return _shaped(raw.astype(np.bool_, copy=False), shape, name)


def _read(value: ArrayLike, name: str, dtype: type[np.float64] | None = None) -> NDArray[Any]:
    try:
        return np.asarray(value, dtype=dtype)
    except (ValueError, TypeError):  # words, or rows of different lengths
        raise SemvizError(f"{name} is not an array of numbers") from None


def _shaped(array: Array, shape: tuple[int | None, ...], name: str) -> Array:
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("n" if side is None else str(side) for side in shape) + ")"
        raise SemvizError(f"{name} has shape {array.shape}, expected {wanted}")
    view = array.view()
    view.flags.writeable = False  # the values are frozen; the caller's own array stays writeable
    return view

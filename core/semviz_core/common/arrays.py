"""Array types, the checks of arrays that enter the program, and unit vectors."""

import math
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semviz_core.common.errors import SemvizError

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
ByteImage: TypeAlias = NDArray[np.uint8]
"""(height, width, 3) sRGB, red first."""

LARGEST = 1e12
"""No coordinate, pixel or variance is larger; squares of larger ones would lose all digits."""

Scalar = TypeVar("Scalar", bound=np.generic)
Floats = TypeVar("Floats", np.float32, np.float64)


def float_array(
    value: ArrayLike, shape: tuple[int | None, ...], name: str, *, nan: bool = False
) -> FloatArray:
    """Return ``value`` as a read-only, C-contiguous float64 array of ``shape`` (None: any length).

    Raise SemvizError, with ``name`` and the place, if the shape differs or a number is infinite,
    beyond ``LARGEST`` or, unless ``nan`` is set, NaN.
    """
    array = _shaped(_read(value, name, np.float64), shape, name)
    if not array.size:
        return array
    low, high = (np.fmin, np.fmax) if nan else (np.minimum, np.maximum)  # fmin skips NaN
    lowest, highest = float(low.reduce(array, axis=None)), float(high.reduce(array, axis=None))
    in_range = lowest >= -LARGEST and highest <= LARGEST
    if not (in_range or (nan and math.isnan(lowest))):
        _raise_for_numbers(array, name, nan)
    return array


def int_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> IntArray:
    """Return ``value`` as a read-only, C-contiguous int64 array of ``shape`` (None: any length)."""
    raw = _read(value, name)
    if raw.size and raw.dtype.kind not in "iu":
        raise SemvizError(f"{name} must hold whole numbers, not {raw.dtype}; use .astype(int)")
    if raw.dtype == np.uint64 and (raw > np.iinfo(np.int64).max).any():
        raise SemvizError(f"{name} holds numbers beyond 64 bits; number anew")
    return _shaped(raw.astype(np.int64, copy=False), shape, name)


def bool_array(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> BoolArray:
    """Return ``value`` as a read-only, C-contiguous bool array of ``shape`` (None: any length)."""
    raw = _read(value, name)
    if raw.size and raw.dtype != np.bool_:
        raise SemvizError(f"{name} must hold true or false, not {raw.dtype}; use .astype(bool)")
    return _shaped(raw.astype(np.bool_, copy=False), shape, name)


def first_place(wrong: BoolArray) -> str:
    """Return the index of the first True of ``wrong``, for messages: ``[3, 1]``."""
    return str([int(index) for index in np.argwhere(wrong)[0]])


def unit_vectors(vectors: NDArray[Floats]) -> NDArray[Floats]:
    """Return ``vectors`` (..., d) with length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))


def _read(value: ArrayLike, name: str, dtype: type[np.float64] | None = None) -> NDArray[Any]:
    try:
        array = np.asarray(value, order="C")
        if dtype is None:
            return array
        if array.dtype.kind not in "biufO":  # O: None among numbers becomes NaN
            raise TypeError
        return array.astype(dtype, copy=False)
    except (ValueError, TypeError, OverflowError):  # strings, or rows of different lengths
        raise SemvizError(
            f"{name} is not an array of numbers: give rows of equal length, without text"
        ) from None


def _shaped(array: NDArray[Scalar], shape: tuple[int | None, ...], name: str) -> NDArray[Scalar]:
    if array.shape == (0,) and shape[:1] == (None,):  # [] stands for no rows
        array = np.empty([side or 0 for side in shape], array.dtype)
    if array.shape != shape and not _fits(array.shape, shape):
        expected = "(" + ", ".join("n" if side is None else str(side) for side in shape) + ")"
        raise SemvizError(f"{name} has shape {array.shape}, expected {expected}")
    view = array.view()
    view.flags.writeable = False  # the caller's own array stays writeable
    return view


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(
        side is None or length == side for length, side in zip(shape, expected, strict=True)
    )


def _raise_for_numbers(array: FloatArray, name: str, nan: bool) -> None:
    what = "NaN or infinite numbers"
    wrong = np.asarray(np.isinf(array) if nan else ~np.isfinite(array))
    if not wrong.any():
        what, wrong = f"numbers beyond {LARGEST:g}", np.abs(array) > LARGEST
    where = f", first at {first_place(wrong)}" if array.ndim else ""
    raise SemvizError(f"{name} holds {what}{where}; remove or repair them")

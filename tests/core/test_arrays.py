"""Unit vectors."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semviz_core.common.arrays import FloatArray, unit_vectors

VECTORS = arrays(
    np.float64, st.tuples(st.integers(0, 5), st.integers(1, 4)), elements=st.floats(-1e6, 1e6)
)


@given(VECTORS)
def test_unit_vectors_keep_their_direction_and_zeros_stay(vectors: FloatArray) -> None:
    length, unit = np.linalg.norm(vectors, axis=1), unit_vectors(vectors)
    np.testing.assert_allclose(np.linalg.norm(unit[length > 1e-6], axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(unit * length[:, None], vectors, rtol=1e-9, atol=1e-9)
    assert not unit[~vectors.any(axis=1)].any()

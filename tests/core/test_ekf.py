"""The update row after row gives what the textbook's formula gives for all rows at once."""

import numpy as np
import pytest

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.tracking.association import PairRows
from semviz_core.tracking.ekf import kalman_update

ELEMENTS = 5


def random_rows(rng: np.random.Generator, pairs: int) -> PairRows:
    """As of a camera 10 m away: pixels by metres and radians; some rows not used."""
    used = rng.random((pairs, 4)) < 0.7
    shape = np.where(used, 1.0, 0.0)
    return PairRows(
        residual_px=shape * rng.normal(0.0, 3.0, (pairs, 4)),
        used=used,
        is_bottom=np.zeros((pairs, 4), dtype=bool),
        by_pose=shape[..., None] * rng.normal(0.0, [70, 70, 70, 700, 700, 700], (pairs, 4, 6)),
        by_element=shape[..., None] * rng.normal(0.0, 70.0, (pairs, 4, 6)),
        variance_px2=np.where(used, rng.uniform(0.5, 9.0, (pairs, 4)), 1.0),
        clutter=np.zeros((pairs, 4)),
        length_px=np.ones(pairs),
    )


def joseph(
    P: FloatArray, rows: PairRows, element: IntArray, around: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step and covariance by Joseph's form."""
    H = np.zeros((len(element), 4, len(P)))
    H[:, :, :6] = rows.by_pose
    for pair, row in enumerate(element):
        H[pair, :, 6 + 6 * row : 12 + 6 * row] = rows.by_element[pair]
    H, R = H[rows.used], np.diag(rows.variance_px2[rows.used])
    gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    left = np.eye(len(P)) - gain @ H
    step = -gain @ (rows.residual_px[rows.used] - H @ around)
    return step, left @ P @ left.T + gain @ R @ gain.T


@pytest.mark.parametrize("sigma_m", [0.05, 3.0])
@pytest.mark.parametrize("pairs", [1, 4, 12])
def test_as_the_textbook(pairs: int, sigma_m: float) -> None:
    """A pose known well or badly, correlated with elements, some of which are seen twice."""
    rng = np.random.default_rng(pairs)
    size = 6 + 6 * ELEMENTS
    sigma = np.concatenate([np.repeat([sigma_m, 0.03 * sigma_m], 3), np.full(size - 6, 0.1)])
    mixed = np.linalg.qr(rng.normal(size=(size, size)) + 3.0 * np.eye(size))[0]
    root = sigma[:, None] * mixed * rng.uniform(0.3, 1.0, size)
    P, around = root @ root.T, 0.01 * rng.normal(size=size)
    element = rng.integers(ELEMENTS, size=pairs)
    rows = random_rows(rng, pairs)

    step, covariance = kalman_update(P, rows, element, around)

    expected_step, expected = joseph(P, rows, element, around)
    np.testing.assert_allclose(step, expected_step, atol=1e-9)
    np.testing.assert_allclose(covariance, expected, atol=1e-9)
    assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] > 0.0


def test_nothing_used_changes_nothing() -> None:
    rows = random_rows(np.random.default_rng(0), 3)
    unused = PairRows(**{**vars(rows), "used": np.zeros((3, 4), dtype=bool)})
    step, covariance = kalman_update(np.eye(12), unused, np.zeros(3, np.int64), np.ones(12))
    np.testing.assert_array_equal(step, 0.0)
    np.testing.assert_array_equal(covariance, np.eye(12))

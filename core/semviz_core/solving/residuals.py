"""The one definition of residual, chi2 and inlier of pairs under a pose, and the prior's residuals.

A point gives two rows, u and v. A pole gives up to four: how far each observed end lies beside the
projected line, and how far the peak and the bottom lie along it, where known on both sides. The
OBSERVED ends are measured against the PROJECTED infinite line, not the other way round: they
lie in the image with noise that is stated, while mapped ends can be behind the camera or far beyond
what was seen, where the observed line extrapolates badly. So a pole counts whatever its bottom
does.

Every row has the covariance of the detection plus the map's, projected into the image. Functions
take a batch of poses: (b, 3, 3) and (b, 3), and pairs (b, k). Pixels are undistorted ones.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri  # the chi-square quantile; scipy.stats is slow to import

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M, Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.pose import Pose

INLIER_PROBABILITY = 0.999
"""Share of true pairs that pass the inlier test when sigmas are stated truly."""
INLIER_CHI2: FloatArray = np.concatenate([[0.0], chdtri(np.arange(1, 5), 1.0 - INLIER_PROBABILITY)])
"""(5,) largest chi2 of an inlier by its number of rows."""
_MISSED_PX = 1e6  # residual of something that doesn't project at all
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class PairResiduals:
    """k pairs under one pose."""

    residual_px: FloatArray
    """(k, 2) detection minus projection: u, v of points; across (the larger of both ends) and
    along poles (peak, else bottom). NaN where not known, and where nothing projects."""
    chi2: FloatArray
    """(k,) squared residual of all rows over their covariance; inf where nothing projects."""
    rows: IntArray
    """(k,) number of rows behind chi2: 2 for points, 2 to 4 for poles."""
    inlier: BoolArray
    """(k,) chi2 below INLIER_CHI2 for its number of rows."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Observed and mapped elements as plain arrays, ends of points set to their anchors."""

    K: FloatArray
    anchor_px: FloatArray  # (m, 2) undistorted
    end_px: FloatArray
    direction: FloatArray  # (m, 2) unit, along the observed pole from peak to bottom
    is_line: BoolArray  # (m,)
    variance_px2: FloatArray  # (m, 2) across, along
    seen_known: BoolArray  # (m, 2) peak, bottom
    anchor_m: FloatArray  # (n, 3)
    end_m: FloatArray
    covariance_m2: FloatArray  # (n, 6, 6)
    mapped_known: BoolArray  # (n, 2)
    compatible: BoolArray  # (m, n) same class and kind

    @classmethod
    def of(cls, camera: Camera, observed: Elements2D, elements: Elements3D) -> "Scene":
        line, mapped_line = observed.is_line, elements.is_line
        anchor = _ideal(camera, observed.anchor_px)
        end = np.where(line[:, None], observed.end_px, observed.anchor_px)
        end = _ideal(camera, end) if camera.distortion.size else end
        along = end - anchor
        length = np.linalg.norm(along, axis=1, keepdims=True)
        down = np.array([0.0, 1.0])
        return cls(
            K=camera.K,
            anchor_px=anchor,
            end_px=end,
            direction=np.where(length > _TINY, along / np.maximum(length, _TINY), down),
            is_line=line,
            variance_px2=observed.sigma_px**2,
            seen_known=np.column_stack([observed.anchor_known, observed.end_known]),
            anchor_m=elements.anchor_m,
            end_m=np.where(mapped_line[:, None], elements.end_m, elements.anchor_m),
            covariance_m2=elements.covariance_m2,
            mapped_known=np.column_stack([elements.anchor_known, elements.end_known]),
            compatible=(observed.class_id[:, None] == elements.class_id)
            & (line[:, None] == mapped_line),
        )


@dataclass(frozen=True, eq=False)
class Rows:
    """Residual rows of pairs (b, k); unused rows are 0 with variance 1."""

    residual: FloatArray  # (b, k, 4)
    used: BoolArray  # (b, k, 4)
    by_anchor: FloatArray  # (b, k, 4, 3) derivative by the anchor in camera coordinates
    by_end: FloatArray
    anchor_c: FloatArray  # (b, k, 3)
    end_c: FloatArray

    def jacobian(self) -> FloatArray:
        """(b, k, 4, 6) derivative by the left perturbation of the pose: metres, then radians."""
        turn = cross(self.anchor_c[..., None, :], self.by_anchor) + cross(
            self.end_c[..., None, :], self.by_end
        )
        return np.concatenate([self.by_anchor + self.by_end, turn], axis=-1)


def pair_residuals(
    T_camera_map: Pose, camera: Camera, observed: Elements2D, elements: Elements3D, pairs: IntArray
) -> PairResiduals:
    """Residuals of ``pairs`` (k, 2) of rows of ``observed`` and of ``elements``."""
    scene = Scene.of(camera, observed, elements)
    return scene_residuals(scene, T_camera_map, pairs)


def scene_residuals(scene: Scene, T_camera_map: Pose, pairs: IntArray) -> PairResiduals:
    """As ``pair_residuals``, for a scene already made."""
    seen, mapped = pairs[None, :, 0], pairs[None, :, 1]
    rotation, translation = T_camera_map.rotation[None], T_camera_map.translation[None]
    rows = residual_rows(scene, rotation, translation, seen, mapped)
    white = whitening(scene, rotation, rows, seen, mapped)
    chi2 = pair_chi2(rows, white)[0]
    count = rows.used[0].sum(axis=1)
    shown = np.where(rows.used[0], rows.residual[0], np.nan)
    shown[~np.isfinite(chi2)] = np.nan
    across = np.where(np.abs(shown[:, 1]) > np.abs(shown[:, 0]), shown[:, 1], shown[:, 0])
    along = np.where(rows.used[0, :, 2], shown[:, 2], shown[:, 3])
    line = scene.is_line[pairs[:, 0]]
    residual = np.where(line[:, None], np.column_stack([across, along]), shown[:, :2])
    return PairResiduals(residual, chi2, count, chi2 <= INLIER_CHI2[count])


def residual_rows(
    scene: Scene, rotation: FloatArray, translation: FloatArray, seen: IntArray, mapped: IntArray
) -> Rows:
    """Rows of the pairs ``seen``, ``mapped`` (b, k) under b poses T_camera_map."""
    anchor_c = _moved(rotation, translation, scene.anchor_m[mapped])
    end_c = _moved(rotation, translation, scene.end_m[mapped])
    anchor_px, end_px = scene.anchor_px[seen], scene.end_px[seen]
    line = np.broadcast_to(scene.is_line[seen], anchor_c.shape[:-1])
    peak_offset, peak_slope, peak_ahead = _offset(scene.K, anchor_px, anchor_c)
    foot_offset, foot_slope, foot_ahead = _offset(scene.K, end_px, end_c)

    beside, beside_anchor, beside_end = _beside(scene.K, anchor_px, end_px, anchor_c, end_c)
    direction = scene.direction[seen][..., None, :]
    known = scene.seen_known[seen] & scene.mapped_known[mapped]
    used = np.empty((*line.shape, 4), dtype=bool)
    used[..., :2] = True
    used[..., 2] = line & known[..., 0] & peak_ahead
    used[..., 3] = line & known[..., 1] & foot_ahead

    shape = (*line.shape, 4)
    residual, by_anchor, by_end = np.zeros(shape), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    as_line = line[..., None]
    residual[..., :2] = np.where(as_line, beside, peak_offset)
    residual[..., 2] = (direction[..., 0, :] * peak_offset).sum(axis=-1)
    residual[..., 3] = (direction[..., 0, :] * foot_offset).sum(axis=-1)
    by_anchor[..., :2, :] = np.where(as_line[..., None], beside_anchor, peak_slope)
    by_anchor[..., 2, :] = (direction @ peak_slope)[..., 0, :]
    by_end[..., :2, :] = np.where(as_line[..., None], beside_end, 0.0)
    by_end[..., 3, :] = (direction @ foot_slope)[..., 0, :]
    lost = ~np.where(line, peak_ahead | foot_ahead, peak_ahead)
    residual[lost] = _MISSED_PX
    residual[~used] = 0.0
    by_anchor[~used] = 0.0
    by_end[~used] = 0.0
    return Rows(residual, used, by_anchor, by_end, anchor_c, end_c)


def whitening(
    scene: Scene, rotation: FloatArray, rows: Rows, seen: IntArray, mapped: IntArray
) -> FloatArray:
    """(b, k, 4, 4) lower triangular W with W S W^T = I, S the covariance of the rows."""
    by_map = np.concatenate(
        [rows.by_anchor @ rotation[:, None], rows.by_end @ rotation[:, None]], axis=-1
    )
    covariance = by_map @ scene.covariance_m2[mapped] @ np.swapaxes(by_map, -1, -2)
    variance = scene.variance_px2[seen]
    across = np.where(scene.is_line[seen], variance[..., 0], variance[..., 1])
    detection = np.stack([variance[..., 0], across, variance[..., 1], variance[..., 1]], axis=-1)
    index = np.arange(4)
    covariance[..., index, index] += np.where(rows.used, detection, 1.0)
    inverse: FloatArray = np.linalg.inv(np.linalg.cholesky(covariance))
    return inverse


def pair_chi2(rows: Rows, white: FloatArray) -> FloatArray:
    """(b, k) squared whitened residual; inf where nothing projects."""
    whitened = (white @ rows.residual[..., None])[..., 0]
    chi2 = (whitened**2).sum(axis=-1)
    return np.where(np.abs(rows.residual).max(axis=-1) < _MISSED_PX, chi2, np.inf)


def prior_rows(
    prior: Prior, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The prior's whitened residuals (b, r) and their Jacobians (b, r, 6): place, up, heading."""
    place = -np.einsum("bji,bj->bi", rotation, translation) - prior.position_m
    sigma = np.array([prior.horizontal_sigma_m] * 2 + [prior.vertical_sigma_m])
    zero = np.zeros((len(rotation), 3, 3))
    residuals = [place / sigma]
    back = np.swapaxes(rotation, -1, -2)
    jacobians = [np.concatenate([-back, zero], axis=-1) / sigma[:, None]]
    if prior.up_camera is not None:
        up = rotation[:, :, 2]
        across = perpendicular(prior.up_camera)
        residuals.append(up @ across.T / prior.up_sigma_rad)
        # d(up) = w x up, so the row e gives e . (w x up) = (up x e) . w
        turn = cross(up[:, None, :], across[None])
        jacobians.append(np.concatenate([np.zeros_like(turn), turn], axis=-1) / prior.up_sigma_rad)
    if prior.heading_rad is not None:
        ahead = rotation[:, 2, :]
        flat = np.maximum(ahead[:, 0] ** 2 + ahead[:, 1] ** 2, _TINY)
        error = np.arctan2(ahead[:, 1], ahead[:, 0]) - prior.heading_rad
        error = np.arctan2(np.sin(error), np.cos(error))
        # d(ahead) = R^T (z x w), so the row g gives (R g) . (z x w) = ((R g) x z) . w
        g = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))], axis=-1) / flat[:, None]
        turn = cross((rotation @ g[..., None])[..., 0], np.array([0.0, 0.0, 1.0]))
        row = np.concatenate([np.zeros_like(turn), turn], axis=-1)[:, None, :]
        residuals.append(error[:, None] / prior.heading_sigma_rad)
        jacobians.append(row / prior.heading_sigma_rad)
    return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product over the last axis; numpy's takes five times as long on small arrays."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def perpendicular(unit: FloatArray) -> FloatArray:
    """(2, 3) two unit vectors perpendicular to ``unit`` and to each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
    first = cross(unit, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, cross(unit, first)])


def _ideal(camera: Camera, pixels_px: FloatArray) -> FloatArray:
    """Pixels of the same camera without distortion."""
    if not camera.distortion.size:
        return pixels_px
    plane = camera.normalize(pixels_px)
    return plane @ camera.K[:2, :2].T + camera.K[:2, 2]


def _moved(rotation: FloatArray, translation: FloatArray, points_m: FloatArray) -> FloatArray:
    return points_m @ np.swapaxes(rotation, -1, -2) + translation[:, None, :]


def _offset(
    K: FloatArray, pixels_px: FloatArray, points_c: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Detection minus projection (..., 2), its derivative by the point (..., 2, 3), if ahead."""
    ahead = points_c[..., 2] > MIN_DEPTH_M
    depth = np.where(ahead, points_c[..., 2], 1.0)[..., None]
    offset = pixels_px - (points_c / depth) @ K[:2].T
    plane = offset - pixels_px  # minus the projection
    third = np.zeros((*plane.shape, 3))
    third[..., 2] = plane / depth
    slope = -(K[:2] / depth[..., None]) - third
    return offset, slope, ahead


def _beside(
    K: FloatArray,
    anchor_px: FloatArray,
    end_px: FloatArray,
    anchor_c: FloatArray,
    end_c: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far both observed ends lie beside the projected line (..., 2), and the derivatives.

    The line through the projections is l = K^-T (end x anchor); positive is to the right of a
    pole that stands upright in the image.
    """
    inverse = np.linalg.inv(K)
    line = cross(end_c, anchor_c) @ inverse
    norm = np.maximum(np.hypot(line[..., 0], line[..., 1]), _TINY)[..., None]
    ends = np.ones((*anchor_c.shape[:-1], 2, 3))
    ends[..., 0, :2] = anchor_px
    ends[..., 1, :2] = end_px
    beside = (ends @ line[..., None])[..., 0] / norm
    normal = np.concatenate([line[..., :2] / norm, np.zeros_like(norm)], axis=-1)
    by_line = (ends - beside[..., None] * normal[..., None, :]) / norm[..., None]
    ray = by_line @ inverse.T
    by_anchor = cross(ray, end_c[..., None, :])
    by_end = cross(anchor_c[..., None, :], ray)
    return beside, by_anchor, by_end

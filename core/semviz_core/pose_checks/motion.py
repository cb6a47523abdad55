"""Relative motion of the camera between two frames, measured by tracked points alone.

Each point has three unknowns, its direction and inverse depth in the first frame. They are
eliminated, so what remains is the motion and the errors of the stereo calibration. Weights of
points are robust: other vehicles count as outliers. With one camera the length of the motion is
unknown; it is then held, and has no information.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import BoolArray, FloatArray, float_array
from semviz_core.pose_checks.tracks import PointTracks

MOTION, RIG = slice(0, 6), slice(6, 9)
UNKNOWNS = 9
"""Six of the motion, then three of the rig; see ``Motion``."""
MIN_POINTS = 25
MIN_SHARE = 0.25
"""Fewer inliers, or a smaller share of the points, are no measurement."""
SIGMA_LIMITS_PX = (0.12, 0.6)
"""The error of a tracked point is estimated between these."""
FLOOR_M, FLOOR_SHARE, FLOOR_RAD = 0.002, 0.003, float(np.deg2rad(0.006))
"""Errors of a measured motion that more points do not reduce: m, share of the length, rad."""
MOST_STEP = np.array([0.02, 0.02, 0.5])
"""Of a point in one iteration, so that outliers do not run away: plane coordinates, 1 / m."""
_STEPS = 12
_VIEWS = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """The camera's motion between two frames, as the images measure it.

    Near ``T_now_before`` the points' chi2 is quadratic in z: a left perturbation of
    ``T_now_before`` (6: metres, then radians), and the errors of the rig (3): the logarithm of the
    true over the calibrated baseline, and the shift of the right image against its calibration
    (px along u and v). chi2(z) = z^T information z - 2 linear^T z + constant.
    """

    T_now_before: Pose
    information: FloatArray
    """(9, 9); singular where the points do not measure: the rig, the length with one camera."""
    linear: FloatArray
    """(9,)"""
    points: int
    """Number of inliers; 0 where nothing was measured."""
    share: float
    """Inliers among all tracked points."""
    parallax_px: float
    """Median distance that inliers move in the image beyond the camera's rotation."""

    def __post_init__(self) -> None:
        size = UNKNOWNS
        for name, shape in (("information", (size, size)), ("linear", (size,))):
            array = float_array(getattr(self, name), shape, f"motion: {name}")
            object.__setattr__(self, name, array)

    @property
    def is_measured(self) -> bool:
        return self.points > 0

    @classmethod
    def unknown(cls) -> "Motion":
        """Return what images without common points measure."""
        return cls(Pose.identity(), np.zeros((UNKNOWNS,) * 2), np.zeros(UNKNOWNS), 0, 0.0, 0.0)

    def with_length(self, length_m: float) -> "Motion":
        """Return the motion of one camera with this length, which is not measured."""
        known = float(np.linalg.norm(self.T_now_before.translation))
        if not self.is_measured or known == 0.0 or length_m <= 0.0:
            return self
        ratio = length_m / known
        scale = np.ones(UNKNOWNS)
        scale[:3] = 1.0 / ratio
        pose = Pose(self.T_now_before.rotation, self.T_now_before.translation * ratio)
        information = self.information * np.outer(scale, scale)
        return replace(self, T_now_before=pose, information=information, linear=self.linear * scale)


def measure_motion(tracks: PointTracks, rig: Rig) -> Motion:
    """Return the motion that ``tracks`` show; ``Motion.unknown()`` where they do not."""
    points = _Points.of(tracks, rig)
    if len(tracks) < MIN_POINTS:
        return Motion.unknown()
    start = _start_stereo(tracks, rig) if rig.right is not None else _start_one_camera(tracks, rig)
    if start is None:
        return Motion.unknown()
    return _refined(points, *start)


@dataclass(frozen=True, eq=False)
class _Points:
    """n points in four views: left and right before, left and right now."""

    px: FloatArray
    """(n, 4, 2) without distortion; 0 where not seen."""
    seen: BoolArray
    """(n, 4)"""
    K: FloatArray
    """(4, 3, 3)"""
    plane: FloatArray
    """(n, 3) the left image's points before, at depth 1."""
    T_right_left: Pose | None

    @classmethod
    def of(cls, tracks: PointTracks, rig: Rig) -> "_Points":
        right = rig.right or rig.left
        cameras = (rig.left, right, rig.left, right)
        views = (
            tracks.before_left_px,
            tracks.before_right_px,
            tracks.now_left_px,
            tracks.now_right_px,
        )
        planes = [
            np.column_stack([camera.normalize(np.nan_to_num(view)), np.ones(len(tracks))])
            for camera, view in zip(cameras, views, strict=True)
        ]
        K = np.array([camera.K for camera in cameras])
        px = np.einsum("vij,vnj->nvi", K[:, :2], np.array(planes))
        seen = np.stack([np.isfinite(view[:, 0]) for view in views], axis=1)
        return cls(px, seen, K, planes[0], rig.T_right_left)

    @property
    def has_length(self) -> bool:
        return self.T_right_left is not None


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Motion, shift of the right image (px, along v) and the points (n, 3): x, y, 1 / depth."""

    T_now_before: Pose
    down_px: float
    points: FloatArray

    def moved(self, step: FloatArray, point_steps: FloatArray) -> "_Estimate":
        turned = Pose(so3_exp(step[3:6]), step[:3])
        points = self.points + point_steps
        return _Estimate(turned @ self.T_now_before, self.down_px + float(step[8]), points)


def _start_stereo(tracks: PointTracks, rig: Rig) -> tuple[Pose, FloatArray] | None:
    """Return T_now_before and inverse depths (n,), from points that stereo places."""
    import cv2

    assert rig.right is not None
    assert rig.T_right_left is not None
    left = rig.left.normalize(np.nan_to_num(tracks.before_left_px))
    right = rig.right.normalize(np.nan_to_num(tracks.before_right_px))
    R, t = rig.T_right_left.rotation, rig.T_right_left.translation
    rays = np.column_stack([left, np.ones(len(left))]) @ R.T
    # u_right = (r_x + rho t_x) / (r_z + rho t_z), solved for rho = 1 / depth
    inverse = (right[:, 0] * rays[:, 2] - rays[:, 0]) / (t[0] - right[:, 0] * t[2])
    seen = np.isfinite(tracks.before_right_px[:, 0])
    inverse = np.where(seen, np.clip(inverse, 1e-4, 2.0), 1e-2)
    placed = seen & (inverse > 4e-3)
    if placed.sum() < MIN_POINTS:
        return None
    points = np.column_stack([left, np.ones(len(left))])[placed] / inverse[placed, None]
    now = rig.left.normalize(tracks.now_left_px[placed])
    cv2.setRNGSeed(0)
    limit = 1.5 / rig.left.K[0, 0]
    ok, rotvec, translation, _ = cv2.solvePnPRansac(
        points, now, np.eye(3), None, iterationsCount=200, reprojectionError=limit, confidence=0.999
    )
    if not ok:
        return None
    return Pose.from_rotvec(rotvec.ravel(), translation.ravel()), inverse


def _start_one_camera(tracks: PointTracks, rig: Rig) -> tuple[Pose, FloatArray] | None:
    """Return T_now_before, of length 1, and inverse depths (n,)."""
    import cv2

    before = rig.left.normalize(tracks.before_left_px)
    now = rig.left.normalize(tracks.now_left_px)
    cv2.setRNGSeed(0)
    limit = 1.0 / rig.left.K[0, 0]
    E, mask = cv2.findEssentialMat(before, now, np.eye(3), cv2.RANSAC, 0.999, limit)
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, before, now, np.eye(3), mask=mask)
    rays = np.column_stack([before, np.ones(len(before))]) @ R.T
    image = np.column_stack([now, np.ones(len(now))])
    # rays + rho t is parallel to image
    a, b = np.cross(image, rays), np.cross(image, t.ravel())
    inverse = -np.einsum("ni,ni->n", a, b) / np.maximum(np.einsum("ni,ni->n", b, b), 1e-12)
    return Pose(np.asarray(R, float), np.asarray(t, float).ravel()), np.clip(inverse, 1e-4, 2.0)


def _refined(points: _Points, T_now_before: Pose, inverse: FloatArray) -> Motion:
    """Return the least-squares motion with robust weights."""
    start = np.column_stack([points.plane[:, :2], inverse])
    estimate, sigma_px = _Estimate(T_now_before, 0.0, start), 1.0
    free = np.zeros(UNKNOWNS, dtype=bool)
    free[MOTION] = True
    free[8] = points.has_length
    for _ in range(_STEPS):
        residual, J_point, J_shared = _linearized(points, estimate)
        weight, sigma_px = _weights(points, residual, J_point, sigma_px)
        H, b, follow, own = _reduced(residual, J_point, J_shared, weight)
        step = np.zeros(UNKNOWNS)
        damped = H[np.ix_(free, free)] + _gauge(points, estimate)[np.ix_(free, free)]
        if not np.isfinite(damped).all():
            return Motion.unknown()
        step[free] = np.linalg.lstsq(damped, b[free], rcond=1e-12)[0]
        moves = np.clip(own - np.einsum("nik,k->ni", follow, step), -MOST_STEP, MOST_STEP)
        moves[:, 2] = np.maximum(moves[:, 2], -0.5 * np.abs(estimate.points[:, 2]) - 1e-3)
        estimate = estimate.moved(step, moves)
    return _measured(points, estimate, sigma_px)


def _gauge(points: _Points, estimate: _Estimate) -> FloatArray:
    """Return (9, 9) what holds the length of the motion with one camera."""
    held = np.zeros((UNKNOWNS, UNKNOWNS))
    if not points.has_length:
        t = estimate.T_now_before.translation
        held[:3, :3] = 1e8 * np.outer(t, t)
    return held


def _measured(points: _Points, estimate: _Estimate, sigma_px: float) -> Motion:
    residual, J_point, J_shared = _linearized(points, estimate)
    weight, sigma_px = _weights(points, residual, J_point, sigma_px)
    inlier = weight > 0.25 / sigma_px**2
    share = float(inlier.mean())
    if inlier.sum() < MIN_POINTS or share < MIN_SHARE:
        return Motion.unknown()
    H, b, _, _ = _reduced(residual, J_point, J_shared, weight)
    H = _with_floor(H, estimate.T_now_before)
    at = np.zeros(UNKNOWNS)
    at[8] = estimate.down_px
    turned = points.plane @ estimate.T_now_before.rotation.T
    turned_px = turned @ points.K[2, :2].T / np.maximum(turned[:, 2:], 0.05)
    parallax = np.linalg.norm(points.px[:, 2] - turned_px, axis=1)[inlier]
    return Motion(
        estimate.T_now_before,
        H,
        H @ at + b,
        int(inlier.sum()),
        share,
        float(np.median(parallax)),
    )


def _with_floor(H: FloatArray, T_now_before: Pose) -> FloatArray:
    """Return the information (9, 9) of a motion with the errors of ``FLOOR_...`` on top.

    (H^-1 + F)^-1 for a singular H.
    """
    length = float(np.linalg.norm(T_now_before.translation))
    sigma = np.repeat([FLOOR_M + FLOOR_SHARE * length, FLOOR_RAD], 3)
    noise = np.linalg.inv(H[MOTION, MOTION] + np.diag(sigma**-2))
    rows = H[:, MOTION]
    less: FloatArray = H - rows @ noise @ rows.T
    return 0.5 * (less + less.T)


def _linearized(points: _Points, estimate: _Estimate) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (n, 8) px, and their derivatives by point (n, 8, 3) and shared (n, 8, 9).

    Rows of images that do not show a point are zero.
    """
    n = len(points.plane)
    x, y, inverse = estimate.points.T
    ray = np.column_stack([x, y, np.ones(n)])
    motion = estimate.T_now_before
    right = points.T_right_left or Pose.identity()
    bodies = (Pose.identity(), right, motion, right @ motion)
    residual = np.zeros((n, _VIEWS, 2))
    by_point, by_shared = np.zeros((n, _VIEWS, 2, 3)), np.zeros((n, _VIEWS, 2, UNKNOWNS))
    now = ray @ motion.rotation.T + inverse[:, None] * motion.translation
    for view, body in enumerate(bodies):
        q = ray @ body.rotation.T + inverse[:, None] * body.translation
        depth = np.where(q[:, 2] > 0.05, q[:, 2], 0.05)
        plane = q / depth[:, None]
        K = points.K[view][:2]
        px = plane @ K.T
        # d(px) / dq
        D = np.einsum("ij,njk->nik", K[:, :2], _by_direction(plane, depth))
        is_right = view % 2 == 1
        if is_right:
            px = px + np.array([0.0, estimate.down_px])
        residual[:, view] = points.px[:, view] - px
        by_point[:, view, :, :2] = D @ body.rotation[:, :2]
        by_point[:, view, :, 2] = D @ body.translation
        if view >= 2:
            turn = D @ right.rotation if is_right else D
            by_shared[:, view, :, :3] = inverse[:, None, None] * turn
            by_shared[:, view, :, 3:6] = -turn @ _skews(now)
        if is_right:
            by_shared[:, view, :, 6] = inverse[:, None] * (D @ right.translation)
            by_shared[:, view, :, 7:9] = np.eye(2)
    hidden = ~points.seen
    residual[hidden], by_point[hidden], by_shared[hidden] = 0.0, 0.0, 0.0
    rows = 2 * _VIEWS
    return (
        residual.reshape(n, rows),
        by_point.reshape(n, rows, 3),
        by_shared.reshape(n, rows, UNKNOWNS),
    )


def _by_direction(plane: FloatArray, depth: FloatArray) -> FloatArray:
    """Return (n, 2, 3) derivatives of x / z, y / z at depths (n,)."""
    out = np.zeros((len(plane), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1.0 / depth
    out[:, :, 2] = -plane[:, :2] / depth[:, None]
    return out


def _skews(vectors: FloatArray) -> FloatArray:
    """Return (n, 3, 3) with skews(a) b = a x b."""
    x, y, z = vectors.T
    out = np.zeros((len(vectors), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    return out - out.transpose(0, 2, 1)


def _point_normals(J_point: FloatArray) -> FloatArray:
    """Return (n, 3, 3) inverse normal matrices of the points, damped where nothing is seen."""
    A = np.einsum("nri,nrj->nij", J_point, J_point)
    A[:, [0, 1, 2], [0, 1, 2]] += 1e-9 + 1e-9 * np.einsum("nii->ni", A)
    return np.asarray(np.linalg.inv(A))


def _weights(
    points: _Points, residual: FloatArray, J_point: FloatArray, sigma_px: float
) -> tuple[FloatArray, float]:
    """Return weights (n,) in 1 / px^2 and the error of a tracked point in px, from residuals.

    Each point's residual is that with the point itself at its best place (Geman and McClure).
    """
    inverse = _point_normals(J_point)
    toward = np.einsum("nri,nr->ni", J_point, residual)
    sum2 = np.einsum("nr,nr->n", residual, residual)
    sum2 = np.maximum(sum2 - np.einsum("ni,nij,nj->n", toward, inverse, toward), 0.0)
    freedom = np.maximum(2 * points.seen.sum(axis=1) - 3, 1)
    mean2 = sum2 / freedom
    usable = points.seen[:, 2]
    spread = float(np.sqrt(np.median(mean2[usable]) / 0.8)) if usable.any() else sigma_px
    sigma_px = float(np.clip(spread, *SIGMA_LIMITS_PX))
    ratio = mean2 / (4.0 * sigma_px**2)
    return usable / (sigma_px**2 * (1.0 + ratio) ** 2), sigma_px


def _reduced(
    residual: FloatArray, J_point: FloatArray, J_shared: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return normal equations (9, 9), (9,) without the points, and how points follow.

    A point's step is ``own`` (n, 3) less ``follow`` (n, 3, 9) times the shared step.
    """
    inverse = _point_normals(J_point)
    cross = np.einsum("nri,nrk->nik", J_point, J_shared)
    toward = np.einsum("nri,nr->ni", J_point, residual)
    follow = inverse @ cross
    own = np.einsum("nij,nj->ni", inverse, toward)
    H = np.einsum("n,nrk,nrl->kl", weight, J_shared, J_shared, optimize=True)
    H -= np.einsum("n,nik,nil->kl", weight, cross, follow, optimize=True)
    b = np.einsum("n,nrk,nr->k", weight, J_shared, residual, optimize=True)
    b -= np.einsum("n,nik,ni->k", weight, cross, own, optimize=True)
    return H, b, follow, own

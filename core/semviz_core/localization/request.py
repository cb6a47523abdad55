"""Check elements, camera and prior against each other before localization.

A mistake raises SemvizError with one line: the fault, its place, and the remedy. Poor data is
no mistake and passes. An example shows what a request is.
"""

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky

LEAST_ELEMENTS, MARGIN = 4, 0.2
"""Elements are checked to lie in the image if there are at least so many. Noise, and a detector's
margin, put them up to this share of the image's size outside."""


def check_request(
    observed: Elements2D,
    submap: Elements3D,
    camera: Camera,
    prior: Prior,
    classes: ClassSet,
) -> None:
    """Raise SemvizError if the input is inconsistent; poor data is no mistake and passes."""
    arguments: tuple[tuple[str, object, type], ...] = (
        ("observed", observed, Elements2D),
        ("submap", submap, Elements3D),
        ("camera", camera, Camera),
        ("prior", prior, Prior),
    )
    for name, value, kind in arguments:
        if not isinstance(value, kind):
            raise SemvizError(f"{name} is of type {type(value).__name__}; give {kind.__name__}")
    _check_classes(observed, "observed", classes)
    _check_classes(submap, "map", classes)
    _check_covariances(submap)
    _check_in_image(observed, camera)
    _check_seen_upright(observed, camera, prior)
    _check_mapped_upright(submap)


def _check_classes(elements: Elements2D | Elements3D, whose: str, classes: ClassSet) -> None:
    kinds = 2 * elements.class_id + elements.is_line
    for class_id, is_line in (divmod(kind, 2) for kind in np.unique(kinds).tolist()):
        if class_id not in classes:
            known = ", ".join(f"{class_.id} ({class_.name})" for class_ in classes)
            raise SemvizError(f"{whose} elements have unknown class {class_id}; known: {known}")
        if is_line != (classes[class_id].kind == "line"):
            mistake = "an end, but is a point; make it NaN"
            if not is_line:
                mistake = "no end; give the last visible point and end_known False"
            row = int(np.argmax(kinds == 2 * class_id + is_line))
            name = classes[class_id].name
            raise SemvizError(f"{whose} element in row {row}, a {name}, has {mistake}")


def _check_covariances(submap: Elements3D) -> None:
    row = first_indefinite(submap.covariance_m2)
    if row >= 0:
        raise SemvizError(
            f"map element {submap.id[row]}: its covariance has a negative eigenvalue; "
            "repair or rebuild it"
        )


@compiled
def first_indefinite(covariance: FloatArray) -> int:
    """Return the row of the first matrix of (n, 6, 6) that is no covariance, -1 if none."""
    for row in range(len(covariance)):
        matrix = covariance[row].copy()
        rounding = 1e-6 * (1.0 + np.trace(matrix))  # far above that of any computation
        for k in range(6):
            matrix[k, k] += rounding
        if not cholesky(matrix, 6):
            return row
    return -1


def _check_in_image(observed: Elements2D, camera: Camera) -> None:
    size = np.array([camera.width, camera.height])
    ends = np.stack([observed.anchor_px, observed.end_px])  # (2, m, 2)
    near = ((ends > -MARGIN * size) & (ends < (1.0 + MARGIN) * size)).all(axis=2)
    outside = np.asarray(~near.any(axis=0))
    if len(observed) >= LEAST_ELEMENTS and _most(outside):
        raise SemvizError(
            f"{outside.sum()} of {len(observed)} observed elements lie outside the "
            f"{camera.width}x{camera.height} image; give (column, row), and the image's own camera"
        )


def _check_seen_upright(observed: Elements2D, camera: Camera, prior: Prior) -> None:
    line = observed.is_line
    up = np.array([0.0, -1.0, 0.0]) if prior.up_camera is None else prior.up_camera
    plane = camera.normalize(observed.anchor_px[line])
    down_px = (plane * up[2] - up[:2]) @ camera.K[:2, :2].T  # a peak that sinks
    along_px = observed.end_px[line] - observed.anchor_px[line]
    if _most((along_px * down_px).sum(axis=1) < 0.0):
        raise SemvizError(
            "most observed poles have their peak (anchor_px) below their bottom (end_px); swap "
            "them, or turn prior.up_camera round"
        )


def _check_mapped_upright(submap: Elements3D) -> None:
    along = (submap.anchor_m - submap.end_m)[submap.is_line]
    if _most(along[:, 2] < 0.5 * np.linalg.norm(along, axis=1)):
        raise SemvizError(
            "most mapped poles do not rise from bottom (end_m) to peak (anchor_m); swap the two, "
            "or turn the map so that z is up"
        )


def example_request(classes: ClassSet) -> tuple[Elements2D, Elements3D, Camera, Prior]:
    """Return a frame that every method localizes surely: eight elements, seen without error."""
    K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
    camera = Camera(1200, 360, K)
    kinds = list(classes)
    class_id = [kinds[k % len(kinds)].id for k in range(8)]
    is_line = np.array([classes[id].kind == "line" for id in class_id])[:, None]
    ahead_m = np.array([14.0, 17.0, 19.0, 22.0, 25.0, 28.0, 33.0, 37.0])
    left_m = np.array([4.0, -5.0, 7.0, -3.5, -9.0, 5.0, -6.0, 10.0])
    above_m = np.array([1.2, 0.9, 0.6, 1.5, 0.7, 1.1, 2.0, 0.8])
    anchor = np.column_stack([ahead_m, left_m, above_m])  # from the camera, z up
    bottom = np.where(is_line, anchor * [1.0, 1.0, 0.0] - [0.0, 0.0, 1.6], np.nan)
    R_camera_map = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    anchor_px, end_px = (camera.project(points @ R_camera_map.T) for points in (anchor, bottom))
    observed = Elements2D.from_ends(anchor_px, end_px, class_id)
    submap = Elements3D.from_ends(np.arange(8), anchor, bottom, class_id)
    up, road_m = np.array([0.0, -1.0, 0.0]), np.array([[-1.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    return observed, submap, camera, Prior(np.array([3.0, -2.0, 0.0]), up_camera=up, road_m=road_m)


def _most(wrong: BoolArray) -> bool:
    return bool(2 * wrong.sum() > len(wrong))

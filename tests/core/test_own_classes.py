"""Classes beyond the four: solvers match them by their ids, networks take them for known ones."""

from dataclasses import replace

import numpy as np
import pytest

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, ElementClass, as_known
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.request import example_request

GANTRY = ElementClass(4, "gantry", "line", "G", "line", "#FF9F43", "#8A4B00")
BEACON = ElementClass(9, "beacon", "point", "B", "diamond", "#B388FF", "#5A2CA0")
SIX = ClassSet((*DEFAULT_CLASSES, GANTRY, BEACON))


def own(rows: slice) -> tuple[Elements2D, Elements3D, Camera, Prior]:
    """The example with some elements of the own class of their kind, seen and mapped."""
    observed, submap, camera, prior = example_request(DEFAULT_CLASSES)
    class_id = submap.class_id.copy()
    class_id[rows] = np.where(submap.is_line[rows], GANTRY.id, BEACON.id)
    return replace(observed, class_id=class_id), replace(submap, class_id=class_id), camera, prior


@pytest.mark.parametrize("method", ["search", "learned", "correspondences"])
@pytest.mark.parametrize("rows", [slice(0, 3), slice(None)], ids=["some", "all"])
def test_a_frame_of_own_classes_is_localized(method: str, rows: slice) -> None:
    """Also one in which a network knows none of the classes."""
    localizer = Localizer(method, classes=SIX)
    found = localizer.localize(*own(rows))
    usual = Localizer(method).localize(*example_request(DEFAULT_CLASSES))
    assert found.status == "ok", found.reason
    assert found.T_camera_map is not None
    assert usual.T_camera_map is not None
    off = found.T_camera_map.as_matrix() - usual.T_camera_map.as_matrix()
    assert np.abs(off).max() < 0.01
    names = [class_.name for class_ in localizer.untrained_classes]
    assert names == ([] if method == "search" else ["gantry", "beacon"])


def test_elements_of_other_classes_are_no_pairs() -> None:
    _, submap, camera, prior = own(slice(0, 3))
    observed, *_ = example_request(DEFAULT_CLASSES)
    found = Localizer(classes=SIX).localize(observed, submap, camera, prior)
    assert found.match is not None
    same = observed.class_id[:, None] == submap.class_id
    assert not found.match.probability[:-1, :-1][~same].any()
    assert found.match.probability[:-1, :-1][same].any()


def test_a_network_takes_other_classes_for_known_ones() -> None:
    class_id, is_line = np.array([0, 4, 9, 3]), np.array([True, True, False, False])
    assert as_known(class_id, is_line, DEFAULT_CLASSES).tolist() == [0, 0, 2, 3]
    assert as_known(class_id, is_line, SIX) is class_id

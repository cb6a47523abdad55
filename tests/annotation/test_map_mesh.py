"""PLY and GLB, read back by trimesh: elements are where they are, coloured, the right way up."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from map_files import small_map

from semviz_annotation.map_formats.exchange import FileFormat, export_map
from semviz_annotation.map_formats.mesh import map_mesh
from semviz_core.common.arrays import FloatArray


def bodies(path: Path) -> list[tuple[FloatArray, FloatArray, list[int]]]:
    """Lower and upper corner of each separate body, and its colour."""
    mesh = trimesh.load(path, force="mesh", process=False)
    found = []
    for part in mesh.split(only_watertight=True):
        colors = np.unique(part.visual.vertex_colors, axis=0)
        assert len(colors) == 1
        found.append((*part.bounds, colors[0].tolist()))
    return found


@pytest.mark.parametrize("format_", ["ply", "glb"])
def test_bodies_are_where_elements_are(tmp_path: Path, format_: FileFormat) -> None:
    town = small_map()
    path = tmp_path / f"town.{format_}"
    report = export_map(town, path)
    assert report.counts == {"poles": 2, "signs": 3}
    turn = np.eye(3) if format_ == "ply" else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    elements = town.elements
    ends = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    middles = 0.5 * (elements.anchor_m + ends) @ turn.T
    found = bodies(path)
    assert len(found) == 5
    for low, high, color in found:
        row = int(np.linalg.norm(middles - 0.5 * (low + high), axis=1).argmin())
        np.testing.assert_allclose(0.5 * (low + high), middles[row], atol=0.09)  # triangles: low
        wanted = [*bytes.fromhex(town.classes[int(elements.class_id[row])].color[1:]), 255]
        if format_ == "ply":
            assert color == wanted
        else:  # linear light
            light = np.array(wanted[:3]) / 255
            assert color[:3] == pytest.approx(255 * light**2.2, abs=4)
    tall = max(found, key=lambda box: float((box[1] - box[0]).max()))
    assert int((tall[1] - tall[0]).argmax()) == (2 if format_ == "ply" else 1)


def test_poles_are_thin_and_plates_face_the_road() -> None:
    town = small_map()
    vertices, faces, _ = map_mesh(town)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0.0  # faces look outward
    pole = vertices[:26]
    axis = (town.elements.anchor_m - town.elements.end_m)[0]
    away = np.cross(pole - town.elements.end_m[0], axis / np.linalg.norm(axis))
    assert np.linalg.norm(away, axis=1).max() == pytest.approx(0.05)
    plate = vertices[2 * 26 : 2 * 26 + 8] - town.elements.anchor_m[2]  # the triangle, at (9, 4)
    ahead = np.array([5.0, 1.5, 0.0]) / np.hypot(5.0, 1.5)  # the road's last step
    assert np.abs(plate @ ahead).max() == pytest.approx(0.01)
    assert plate[:, 2].max() == pytest.approx(0.3)
    assert plate[:, 2].min() == pytest.approx(-0.15)  # its point is up

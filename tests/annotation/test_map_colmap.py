"""COLMAP's text model, parsed back by pycolmap: it projects as we do, half a pixel on."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import rig_view
from semviz_annotation.map_formats.conversion import ExchangeReport
from semviz_annotation.map_formats.exchange import export_colmap
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Dataset
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError

pycolmap = pytest.importorskip("pycolmap")


@dataclass(frozen=True)
class Model:
    """A map of a world, as it was exported."""

    world: Dataset
    semantic_map: SemanticMap
    labels: Labels
    report: ExchangeReport
    folder: Path


def export(world: Dataset, folder: Path) -> Model:
    """The world's landmarks, exactly where they are; no bottoms seen right, no peaks in frame 1."""
    labels = world.labels(sigma_px=0.7)  # type: ignore[attr-defined]
    landmarks = world.landmarks  # type: ignore[attr-defined]
    rows = [
        replace(
            row,
            anchor_known=row.end_px is None or row.frame_index != 1,
            end_known=row.end_known and row.side == "left",
        )
        for row in labels.observations.values()
    ]
    labels = Labels.from_rows([*labels.elements.values(), *rows])
    elements = sorted(labels.elements.values(), key=lambda element: element.number)
    nothing = np.full(3, np.nan)
    ends = [landmarks[element.number][2] for element in elements]
    mapped = Elements3D.from_ends(
        [element.number for element in elements],
        [landmarks[element.number][1] for element in elements],
        [nothing if end is None else end for end in ends],
        [element.class_id for element in elements],
    )
    provenance = tuple(
        Provenance((element.id,), tuple(row.id for row in rows if row.element_id == element.id))
        for element in elements
    )
    semantic_map = SemanticMap(mapped, world.map_frame, provenance=provenance)
    report = export_colmap(semantic_map, labels, world, folder)
    return Model(world, semantic_map, labels, report, folder)


@pytest.fixture
def model(world: Dataset, tmp_path: Path) -> Model:
    return export(world, tmp_path / "model")


def test_points_project_as_ours_do(model: Model) -> None:
    read = pycolmap.Reconstruction(model.folder)
    elements = model.semantic_map.elements
    assert len(read.images) == 10
    for image in read.images.values():
        side, _, name = image.name.partition("/")
        frame = model.world.frames[int(name.removesuffix(".png"))]
        assert frame.T_map_camera is not None
        view = rig_view(model.world.rig, side, frame.T_map_camera.inverse())
        for row, id_ in enumerate(elements.id.tolist()):
            ours = view.project(elements.anchor_m[row : row + 1])[0]
            theirs = image.project_point(read.points3D[2 * id_ + 1].xyz)
            np.testing.assert_allclose(theirs, ours + 0.5, atol=1e-6)
            if elements.end_known[row]:
                bottom = view.project(elements.end_m[row : row + 1])[0]
                theirs = image.project_point(read.points3D[2 * id_ + 2].xyz)
                np.testing.assert_allclose(theirs, bottom + 0.5, atol=1e-6)


def test_observations_are_tracks(model: Model) -> None:
    """Every end that somebody saw is a mark with its point; error and track agree with it."""
    read = pycolmap.Reconstruction(model.folder)
    marks = {
        (image.name, point.point3D_id): point.xy
        for image in read.images.values()
        for point in image.points2D
    }
    numbers = {element.id: element.number for element in model.labels.elements.values()}
    wanted = {}
    for row in model.labels.observations.values():
        name = f"{row.side}/{row.frame_index:06d}.png"
        if row.anchor_known:
            wanted[name, 2 * numbers[row.element_id] + 1] = row.anchor_px
        if row.end_px is not None and row.end_known:
            wanted[name, 2 * numbers[row.element_id] + 2] = row.end_px
    assert marks.keys() == wanted.keys()
    for key, pixel in wanted.items():
        np.testing.assert_allclose(marks[key], np.array(pixel) + 0.5, atol=1e-9)
    for point in read.points3D.values():
        errors = []
        for element in point.track.elements:
            image = read.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            errors.append(np.linalg.norm(image.project_point(point.xyz) - seen))
        assert point.error == pytest.approx(np.mean(errors), abs=1e-9)


def test_what_is_lost_is_listed(model: Model) -> None:
    assert model.report.counts == {"poles": 2, "signs": 2}
    assert model.report.dropped == {
        "lines of poles: their ends are points": 2,
        "classes: colours only": 4,
        "standard deviations and correlations": 4,
    }


def test_ends_that_nobody_saw_are_no_points(model: Model, tmp_path: Path) -> None:
    elements = replace(model.semantic_map.elements, end_known=np.zeros(4, dtype=bool))
    hidden = replace(model.semantic_map, elements=elements)
    report = export_colmap(hidden, model.labels, model.world, tmp_path / "hidden")
    read = pycolmap.Reconstruction(tmp_path / "hidden")
    assert sorted(read.points3D) == [7, 9, 15, 19]
    assert report.dropped["ends that nobody saw"] == 2
    gone = Labels()
    report = export_colmap(hidden, gone, model.world, tmp_path / "gone")
    lost = "observations that were deleted since, or are of no posed frame"
    assert report.dropped[lost] == len(model.labels.observations)


def test_a_camera_with_distortion(make_world: type, world: Dataset, tmp_path: Path) -> None:
    left = world.rig.left
    bent = Camera(left.width, left.height, left.K, np.array([-0.1, 0.02, 0.001, -0.002, 0.01]))
    rig = replace(world.rig, left=bent)
    model = export(make_world(world.landmarks, rig=rig), tmp_path / "model")  # type: ignore[attr-defined]
    read = pycolmap.Reconstruction(model.folder)
    assert [read.cameras[k].model.name for k in (1, 2)] == ["FULL_OPENCV", "PINHOLE"]
    image = read.find_image_with_name("left/000000.png")
    frame = model.world.frames[0]
    assert frame.T_map_camera is not None
    view = rig_view(model.world.rig, "left", frame.T_map_camera.inverse())
    anchor = model.semantic_map.elements.anchor_m
    np.testing.assert_allclose(
        image.project_point(anchor[0]), view.project(anchor[:1])[0] + 0.5, atol=1e-6
    )


def test_nothing_is_overwritten_or_left_half(model: Model, tmp_path: Path) -> None:
    before = (model.folder / "images.txt").read_bytes()
    with pytest.raises(SemvizError, match="already exists; choose a new folder"):
        export_colmap(model.semantic_map, model.labels, model.world, model.folder)
    assert (model.folder / "images.txt").read_bytes() == before
    elements = replace(model.semantic_map.elements, id=np.array([-1, 2, 3, 4]))
    elsewhere = replace(model.semantic_map, frame=MapFrame("moon"))
    with pytest.raises(SemvizError, match="the map is in the frame 'moon', the poses are in 'wor"):
        export_colmap(elsewhere, model.labels, model.world, tmp_path / "other")
    negative = SemanticMap(elements, MapFrame("world"))
    with pytest.raises(SemvizError, match="no negative numbers"):
        export_colmap(negative, model.labels, model.world, tmp_path / "other")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]

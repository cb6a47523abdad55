"""``semviz detect evaluate``: a planted detector's figures, and a report alone in the world.

The detector recognizes the images that it is asked about, and answers with their truth, spoiled.
"""

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from command_line import call
from fonts import FONTS

from semviz.commands.detect import REPORT, DetectEvaluateCommand
from semviz.research.detector_evaluation import EvaluationImage, labelled_images, street_images
from semviz.workspace.demo import LABELLED_EVERY, demo_labels
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import DecideElements, DeleteObservation, ReviewFrame
from semviz_annotation.labels.rows import review_decision
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D, joined
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import IGNORED, SHORTEST_PX, match_detections

if TYPE_CHECKING:
    from playwright.sync_api import Page

STREETS, FRAMES = 2, 2
TAKEN = "taken for a rounded sign"
LABELS = Path(__file__).parents[2] / "docs" / "kitti02" / "labels.jsonl"
LABELLED = range(0, 9, LABELLED_EVERY)
NO_SLIP = -1
NAMED = SimpleNamespace(name="<planted>")
Spoil = Callable[[Elements2D], Elements2D]


@dataclass(frozen=True)
class Planted:
    """A detector that knows the truth of some images."""

    truths: dict[bytes, Elements2D]
    spoil: Spoil
    model: Any
    measuring: str = "edges"
    triangle_center: str = "centroid"  # as streets and new labels

    @classmethod
    def of(cls, images: tuple[EvaluationImage, ...], spoil: Spoil) -> "Planted":
        return cls(
            {image.read().tobytes(): image.truth().elements for image in images}, spoil, NAMED
        )

    def detect(self, image: np.ndarray) -> Elements2D:
        return self.spoil(self.truths[image.tobytes()])


def spoiled(true: Elements2D) -> Elements2D:
    """Every third is missed, triangular signs are taken for rounded ones, one pole is invented."""
    kept = true[np.arange(len(true)) % 3 != 0]
    kinds = np.where(kept.class_id == TRIANGULAR, ROUNDED, kept.class_id)
    found = replace(kept, class_id=kinds, score=np.linspace(0.9, 0.5, len(kept)))
    invented = Elements2D.from_ends([[600.0, 20.0]], [[600.0, 80.0]], [POLE])
    return joined(found, replace(invented, score=[0.7]))


@pytest.fixture(scope="module")
def images() -> tuple[EvaluationImage, ...]:
    """Painted once."""
    made = street_images(STREETS, FRAMES, ("left",))
    return tuple(replace(image, read=cache(image.read), truth=cache(image.truth)) for image in made)


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def planted(images: tuple[EvaluationImage, ...], spoil: Spoil) -> None:
        detector = Planted.of(images, spoil)
        monkeypatch.setattr("semviz.research.detector_evaluation.street_images", lambda *_: images)
        monkeypatch.setattr("semviz_core.detection.detector.load_detector", lambda *_: detector)

    return planted


def on_streets(**options: Any) -> DetectEvaluateCommand:
    return DetectEvaluateCommand(streets=STREETS, frames_a_street=FRAMES, **options)


def told(capsys: pytest.CaptureFixture[str], command: DetectEvaluateCommand) -> dict[str, Any]:
    assert replace(command, json=True).run() == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a street, labelled on both sides."""
    folder = tmp_path_factory.mktemp("labelled") / "town"
    workspace = Workspace.create_street(folder, 7, range(LABELLED.stop))
    with workspace.open_labels() as store:
        store.apply(demo_labels(workspace.street, NO_SLIP, 0), "tester")
        for index in LABELLED:
            store.apply(ReviewFrame(index, "reviewed"), "tester")
    return folder


def test_the_truth_is_perfect(
    plant: Callable[..., None],
    images: tuple[EvaluationImage, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    plant(images, lambda true: true)
    told_ = told(capsys, on_streets())
    figures = told_["figures"]
    assert told_["settings"]["model"] == "<planted>"
    assert told_["settings"]["images"] == "4 of 2 places, street-30000 to street-30001"
    assert figures["frames"] == STREETS * FRAMES
    assert figures["false_a_frame"] == 0.0
    counted = sum(int(image.truth().counts.sum()) for image in images)
    assert sum(figure["recall"]["of"] for figure in figures["classes"].values()) == counted
    assert all(figure["recall"]["share"] == 1.0 for figure in figures["classes"].values())
    assert 0.0 < figures["time_ms_median"] <= figures["time_ms_p95"]


def test_planted_errors_are_counted(
    plant: Callable[..., None],
    images: tuple[EvaluationImage, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    plant(images, spoiled)
    figures = told(capsys, on_streets(least_score=0.0))["figures"]
    found = dict.fromkeys(figures["classes"], 0)
    swapped = 0
    for image in images:
        truth = image.truth()
        kept = truth.counts & (np.arange(len(truth.counts)) % 3 != 0)
        kinds = truth.elements.class_id[kept]
        found["pole"] += int((kinds == POLE).sum())
        swapped += int((kinds == TRIANGULAR).sum())
    classes = figures["classes"]
    assert classes["pole"]["recall"]["count"] == found["pole"]
    assert classes["triangular sign"]["recall"]["count"] == 0
    assert figures["confusion"][TRIANGULAR][ROUNDED] == swapped > 0
    assert figures["false_a_frame"] * len(images) == len(images) + swapped
    assert figures["confusion"][-1] == [len(images), 0, 0, 0, 0]
    assert figures["threshold"] == 0.0


def test_labels_are_the_truth(
    plant: Callable[..., None], labelled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is mapped and not labelled in an image does not count."""
    workspace = Workspace.open(labelled)
    both = labelled_images(workspace, None, ("left", "right"))
    assert len(both) == 2 * len(LABELLED)
    plant(both, lambda true: true)
    command = DetectEvaluateCommand((labelled,), sides="both")
    figures = told(capsys, command)["figures"]
    assert figures["frames"] == len(both)
    assert figures["false_a_frame"] == 0.0
    assert all(figure["recall"]["share"] in (1.0, None) for figure in figures["classes"].values())
    near = sum(share["of"] for share in figures["classes"]["pole"]["recall_by_distance"])
    assert 30 < near <= figures["classes"]["pole"]["recall"]["of"]
    some = told(capsys, replace(command, frames="3:9", sides="left"))
    assert some["figures"]["frames"] == 2
    assert some["notes"] == []


def test_distances_of_labels_are_those_of_the_street(labelled: Path) -> None:
    workspace = Workspace.open(labelled)
    (first, *_) = labelled_images(workspace, None, ("left",))
    truth = first.truth()
    elements, ids = workspace.street.labels(first.frame_index, "left")
    mapped = workspace.street.truth_map.elements
    center = workspace.street.view(first.frame_index, "left").center_m
    places = mapped.anchor_m[np.searchsorted(mapped.id, ids)] - center
    true_m = np.linalg.norm(places[:, :2], axis=1)
    count = 0
    counted = truth.counts  # others are mapped only, or far
    for anchor, distance in zip(
        truth.elements.anchor_px[counted], truth.distance_m[counted], strict=True
    ):
        row = int(np.linalg.norm(elements.anchor_px - anchor, axis=1).argmin())
        if np.isfinite(distance) and elements.anchor_known[row]:
            assert distance == pytest.approx(true_m[row], rel=0.1, abs=0.5)
            count += 1
    assert count > 5


def test_what_is_left_out_of_maps_does_not_count(labelled: Path, tmp_path: Path) -> None:
    workspace = Workspace.open(shutil.copytree(labelled, tmp_path / "town"))
    before = labelled_images(workspace, None, ("left",))[0].truth()
    labels = workspace.read_labels()
    row = int(np.flatnonzero(before.counts)[0])
    element_id = labels.in_frame(LABELLED[0], "left")[row].element_id
    with workspace.open_labels() as store:
        store.apply(DecideElements((review_decision(element_id, "leave out"),)), "tester")
    number = labels.elements[element_id].number
    ignoring = labelled_images(Workspace.open(labelled), None, ("left",), ignored=(number,))
    for after in (labelled_images(workspace, None, ("left",))[0], ignoring[0]):
        assert before.counts[row]
        assert not after.truth().counts[row]
        assert after.truth().counts.sum() == before.counts.sum() - 1
    with pytest.raises(SemvizError, match="no element 9999 to ignore"):
        labelled_images(workspace, None, ("left",), ignored=(9999,))


def test_what_is_mapped_and_not_labelled_does_not_count(labelled: Path, tmp_path: Path) -> None:
    workspace = Workspace.open(shutil.copytree(labelled, tmp_path / "town"))
    (before, *_) = labelled_images(workspace, None, ("left",))
    truth = before.truth()
    row = int(np.flatnonzero(truth.counts & truth.elements.is_line)[0])
    with workspace.open_labels() as store:
        image = workspace.read_labels().in_frame(before.frame_index, "left")[row]
        store.apply(DeleteObservation(image.id), "tester")
    after = labelled_images(workspace, None, ("left",))[0].truth()
    found = truth.elements[[row]]
    assert match_detections(found, truth).tolist() == [row]
    assert match_detections(found, after).tolist() == [IGNORED]
    assert after.counts.sum() == truth.counts.sum() - 1


@pytest.mark.realdata
def test_labels_of_real_images(kitti_root: Path, tmp_path: Path) -> None:
    """Most of what is labelled in KITTI 02 is farther away than counts by default; elements that
    are left out of maps, and specks, never count."""
    workspace = Workspace.create_kitti(tmp_path / "town", kitti_root, "02", (2, 3), range(20))
    with workspace.open_labels() as store:
        import_operations(LABELS, store)
    rows = [
        row
        for row in workspace.read_labels().without_left_out().observations.values()
        if row.side == "left"
        and (row.end_px is None or math.dist(row.anchor_px, row.end_px) >= SHORTEST_PX)
    ]
    for reach_m, count in ((40.0, 156), (200.0, len(rows))):
        images = labelled_images(workspace, None, ("left",), reach_m)
        assert len(images) == 20
        assert all(image.is_complete for image in images)
        assert sum(int(image.truth().counts.sum()) for image in images) == count


def test_frames_that_nobody_reviewed_are_noted(
    plant: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = Workspace.create_street(tmp_path / "town", 7, range(2))
    with workspace.open_labels() as store:
        store.apply(demo_labels(workspace.street, NO_SLIP, 0), "tester")
    plant(labelled_images(workspace, None, ("left",)), lambda true: true)
    (note,) = told(capsys, DetectEvaluateCommand((workspace.path,)))["notes"]
    assert note.startswith("1 of 1 images are labelled but not reviewed")


@pytest.fixture
def report(
    plant: Callable[..., None],
    images: tuple[EvaluationImage, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> Path:
    plant(images, spoiled)
    assert on_streets(out=tmp_path / "first", least_score=0.0, pictures=50).run() == 0
    assert "rounded: paper" in capsys.readouterr().out
    return tmp_path / "first" / REPORT


def test_a_second_call_gives_the_same_bytes(report: Path, tmp_path: Path) -> None:
    assert on_streets(out=tmp_path / "second", least_score=0.0, pictures=50).run() == 0
    assert (tmp_path / "second" / REPORT).read_bytes() == report.read_bytes()
    assert report.stat().st_size < 1_000_000


def test_the_report_shows_what_went_wrong(report: Path) -> None:
    page = report.read_text()
    missed, invented = (
        re.findall(r"<figcaption><b>(.*?)</b>", part)
        for part in page.split("<h2>Missed")[1].split("<h2>False")
    )
    assert len(missed) > 10
    assert any(fault.startswith("triangular sign, ") and TAKEN in fault for fault in missed)
    away = [int(re.findall(r"(\d+) m away", fault)[0]) for fault in missed]
    assert away == sorted(away)
    assert (
        sum(fault == "pole, score 0.70: nothing is there" for fault in invented) == STREETS * FRAMES
    )
    assert any(
        fault.startswith("rounded sign, ") and "is a triangular sign" in fault for fault in invented
    )
    scores = [float(re.findall(r"score (\d\.\d\d)", fault)[0]) for fault in invented]
    assert scores == sorted(scores, reverse=True)
    assert "&lt;planted&gt;" in page


@pytest.mark.browser
@pytest.mark.parametrize("fonts", FONTS)
@pytest.mark.parametrize("width", [1280, 1920])
def test_the_report_asks_for_nothing_and_nothing_overlaps(
    report: Path, page: "Page", width: int
) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.context.set_offline(True)
    page.set_viewport_size({"width": width, "height": 900})
    page.goto(report.as_uri())
    assert [url for url in asked if not url.startswith("data:")] == [report.as_uri()]
    assert page.locator("script, img, iframe, link, object").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    overlaps = page.evaluate(
        """() => {
          const boxes = [...document.querySelectorAll("h1, h2, p, .table, .plot, .crops > figure")]
            .map((one) => one.getBoundingClientRect());
          return boxes.flatMap((a, i) => boxes.slice(i + 1).filter((b) =>
            Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
            && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)).length;
        }"""
    )
    assert overlaps == 0
    broken = page.evaluate(
        """() => Promise.all([...document.querySelectorAll("image")].map(async (one) => {
          const image = new Image();
          image.src = one.getAttribute("href");
          await image.decode();
          return image.naturalWidth;
        }))"""
    )
    assert len(broken) > 15
    assert min(broken) > 50


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--streets", 0), "--streets 0: give 1 or more"),
        (("--frames-a-street", -1), "--frames-a-street -1: give 1 or more"),
        (("--pictures", -1), "--pictures -1: give 0 or more"),
        (("--reach-m", 3), "--reach-m 3: give more than 3 m"),
        (("--least-score", 1.5), "--least-score 1.5: give a number from 0 to 1"),
        (("--frames", "0:3"), "--frames needs a workspace"),
        (("--model", "none.toml"), "none.toml"),
        (("--model", "none.safetensors"), "none.safetensors"),
        (("none",), "none: no such workspace"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], options: tuple[object, ...], said: str
) -> None:
    status, output, errors = call(capsys, "detect", "evaluate", *options)
    assert (status, output) == (2, "")
    assert said in errors
    assert errors.count("\n") == 1


def test_a_workspace_without_labels_is_refused(
    plant: Callable[..., None], images: tuple[EvaluationImage, ...], tmp_path: Path, labelled: Path
) -> None:
    plant(images, lambda true: true)
    empty = Workspace.create_street(tmp_path / "empty", 3, range(2)).path
    with pytest.raises(SemvizError, match="nothing is labelled; label images with") as refused:
        DetectEvaluateCommand((empty,), out=tmp_path / "out").run()
    assert str(empty) in str(refused.value)
    with pytest.raises(SemvizError, match="nothing is labelled in frames 1:3"):
        DetectEvaluateCommand((labelled,), frames="1:3").run()
    assert not (tmp_path / "out").exists()


def test_ctrl_c_leaves_nothing(
    plant: Callable[..., None], images: tuple[EvaluationImage, ...], tmp_path: Path
) -> None:
    looked = 0

    def interrupted(true: Elements2D) -> Elements2D:
        nonlocal looked
        looked += 1
        if looked == 3:
            raise KeyboardInterrupt
        return true

    plant(images, interrupted)
    with pytest.raises(KeyboardInterrupt):
        on_streets(out=tmp_path / "out").run()
    assert not (tmp_path / "out").exists()

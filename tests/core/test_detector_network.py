"""The detector's network: what its maps tell comes back, and what it is asked to learn is right."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR, ROUNDED
from semviz_core.base.elements import Elements2D
from semviz_core.base.weights import NetworkWeights
from semviz_core.common.errors import SemvizError
from semviz_core.detection.heatmaps import MASKS, STRIDE, Channels, regions_in
from semviz_core.detection.network import (
    DetectorNet,
    HeatmapModel,
    NetworkSize,
    load_shipped_model,
)
from semviz_core.detection.regions import Region
from semviz_core.research.training import detector
from semviz_core.research.training.detector import DetectorTask, chosen_thresholds, focal
from semviz_core.research.training.detector_crops import (
    HEIGHT,
    WIDTH,
    Crop,
    Targets,
    middle_crop,
    random_crop,
    view_elsewhere,
)
from semviz_core.research.training.detector_images import IGNORED, ConcatImages, LabelledImage
from semviz_core.research.training.trainer import Trainer, TrainingOptions

CHANNELS = Channels(len(DEFAULT_CLASSES))
SMALL = NetworkSize((16, 24, 48, 96, 128), (0, 1, 2, 2, 2), 32, 48)
"""Learns faster than the standard one."""


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def an_image() -> LabelledImage:
    """A dark pole and a bright sign on grey, as tall as a crop and as wide."""
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    image[60:301, 98:105] = 30
    image[100:141, 200:241] = (230, 40, 40)
    elements = Elements2D.from_ends(
        [[101.0, 60.0], [220.0, 120.0]], [[101.0, 300.0], [np.nan, np.nan]], [POLE, RECTANGULAR]
    )
    regions = (
        Region(POLE, 1.0, np.array([98.0, 60, 104, 300]), np.ones((241, 7), bool), (98, 60)),
        Region(RECTANGULAR, 1.0, np.array([200.0, 100, 240, 140]), np.ones((41, 41), bool),
               (200, 100)),
    )  # fmt: skip
    return LabelledImage(image, elements, regions)


@dataclass(frozen=True)
class Images:
    """The same image, of which ``count`` are counted."""

    labelled: LabelledImage
    count: int = 2
    held_out_count: int = 1

    def image(self, number: int) -> LabelledImage:
        return self.labelled

    def held_out(self, number: int) -> LabelledImage:
        return self.labelled

    def describe(self) -> dict[str, object]:
        return {"images": self.count}


def as_maps(targets: Targets) -> tuple[np.ndarray, np.ndarray]:
    """The maps and masks of a network that has learned its targets."""
    height, width = targets.counts.shape
    maps = np.zeros((CHANNELS.count, height, width), np.float32)
    heat = np.clip(targets.heat, 1e-4, 1.0 - 1e-4)
    maps[CHANNELS.heat] = np.log(heat / (1.0 - heat))
    maps[CHANNELS.middle], maps[CHANNELS.size] = targets.sign[:2], targets.sign[2:]
    maps[CHANNELS.ends], maps[CHANNELS.width] = targets.pole[:4], targets.pole[4:]
    maps[CHANNELS.known] = 8.0 * targets.known - 4.0
    return maps, 8.0 * targets.mask - 4.0


def told(crop: Crop) -> list[Region]:
    maps, masks = as_maps(Targets.of(crop, DEFAULT_CLASSES))
    return regions_in(maps, masks, np.full(4, 0.5), DEFAULT_CLASSES, (HEIGHT, WIDTH))


def test_what_maps_are_asked_to_tell_comes_back_as_regions() -> None:
    crop = middle_crop(an_image(), 0.5)
    pole, sign = sorted(told(crop), key=lambda element: element.class_id or 0)
    assert (pole.class_id, sign.class_id) == (POLE, RECTANGULAR)
    assert pole.ends_px is not None
    np.testing.assert_allclose(pole.ends_px, [[101.0, 60.0], [101.0, 300.0]], atol=0.01)
    np.testing.assert_allclose(sign.center_px, [220.0, 120.0], atol=0.01)
    np.testing.assert_allclose(sign.box_px[2:] - sign.box_px[:2], [41.0, 41.0], atol=0.6)
    assert pole.ends_known == (True, True)
    assert sign.mask is not None
    assert abs(int(sign.mask.sum()) - 41 * 41) < 41 * 6


@pytest.mark.parametrize("seed", range(12))
def test_elements_of_random_crops_come_back(seed: int) -> None:
    """Larger or smaller, mirrored, cut off: what is learned of a crop is what it shows."""
    crop = random_crop(an_image(), np.random.default_rng(seed), surroundings=0.0)
    found = told(crop)
    assert len(found) == len(crop.elements)
    for row, element_class in enumerate(crop.elements.class_id.tolist()):
        (image,) = [region for region in found if region.class_id == element_class]
        if element_class == POLE:
            assert image.ends_px is not None
            np.testing.assert_allclose(image.ends_px[0], crop.elements.anchor_px[row], atol=0.05)
            np.testing.assert_allclose(image.ends_px[1], crop.elements.end_px[row], atol=0.05)
            known = (crop.elements.anchor_known[row], crop.elements.end_known[row])
            assert image.ends_known == known
        else:
            shown = crop.rows == row + 1
            assert shown.any()
            if crop.elements.anchor_px[row].min() > 40.0:
                np.testing.assert_allclose(image.center_px, crop.elements.anchor_px[row], atol=0.7)


def test_nothing_is_learned_where_nobody_knows() -> None:
    labelled = an_image()
    ignored = np.zeros((HEIGHT, WIDTH), bool)
    ignored[200:260, 280:340] = True
    targets = Targets.of(middle_crop(replace(labelled, ignored=ignored), 0.5), DEFAULT_CLASSES)
    cells = slice(200 // STRIDE, 260 // STRIDE), slice(280 // STRIDE, 340 // STRIDE)
    assert not targets.counts[cells].any()
    assert targets.counts.mean() > 0.9
    logit = torch.zeros(1, 4, *targets.counts.shape)
    wrong = logit.clone()
    wrong[0, 1][cells] = 9.0
    heat, counts = torch.from_numpy(targets.heat)[None], torch.from_numpy(targets.counts)[None]
    assert focal(wrong, heat, counts) == focal(logit, heat, counts)
    assert focal(wrong, heat, torch.ones_like(counts)) > focal(logit, heat, counts)


def test_labels_without_masks_teach_no_sizes() -> None:
    targets = Targets.of(middle_crop(replace(an_image(), regions=None), 0.5), DEFAULT_CLASSES)
    assert targets.sign_weight.any()
    assert targets.pole_weight.any()
    assert not targets.size_weight.any()
    assert not targets.width_weight.any()
    assert not targets.mask_weight.any()
    assert targets.mask_weight.shape == tuple(MASKS * side for side in targets.counts.shape)


def test_pixels_of_an_element_are_those_of_its_row() -> None:
    crop = middle_crop(an_image(), 0.5)
    assert (crop.rows == 1).sum() == 241 * 7
    assert (crop.rows == 2).sum() == 41 * 41
    assert not (crop.rows == IGNORED).any()


def test_a_view_elsewhere_keeps_the_elements_and_adds_others() -> None:
    before = an_image()
    views = [view_elsewhere(before, np.random.default_rng(seed)) for seed in range(6)]
    for view in views:
        assert view.image.shape == before.image.shape
        np.testing.assert_allclose(view.elements.anchor_px[:2], before.elements.anchor_px)
        assert (view.image != before.image).mean() > 0.3
    assert max(len(view.elements) for view in views) > 3


def test_thresholds_are_chosen_elsewhere_unless_there_are_no_masks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[LabelledImage] = []

    def chosen(model, images, classes):
        seen.extend(images)
        return np.full(len(classes), 0.25)

    monkeypatch.setattr(detector, "chosen_thresholds", chosen)
    for labelled in (an_image(), replace(an_image(), regions=None)):
        task = DetectorTask(Images(labelled))
        task.finish()
        assert task.detector.threshold[0] == 0.25
    np.testing.assert_array_equal(seen[1].image, an_image().image)
    assert (seen[0].image != an_image().image).mean() > 0.3


@pytest.mark.parametrize(
    "size", [NetworkSize(), NetworkSize((8, 12, 16, 24, 32), (1, 0, 2, 3, 1), 12, 20)]
)
def test_the_size_of_a_network_is_read_from_its_weights(size: NetworkSize, tmp_path: Path) -> None:
    network = DetectorNet(4, size)
    tensors = {name: value.float().numpy() for name, value in network.state_dict().items()}
    assert NetworkSize.of(tensors) == size
    options = {"classes": [class_.name for class_ in DEFAULT_CLASSES]}
    kept = {name: value for name, value in tensors.items() if "batches" not in name}
    NetworkWeights("detector", options, kept).save(tmp_path / "detector.safetensors")
    loaded = load_shipped_model(tmp_path / "detector.safetensors", DEFAULT_CLASSES)
    assert loaded.network.size == size


def test_it_learns_an_image_by_heart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finds both elements after training, nothing before; and tells from which heat on."""
    monkeypatch.setattr(detector, "view_elsewhere", lambda labelled, _: labelled)
    torch.manual_seed(0)
    task = DetectorTask(Images(an_image()), size=SMALL)
    before = HeatmapModel.of(DetectorNet(4, SMALL), DEFAULT_CLASSES)
    assert not before.find(an_image().image)
    task.make = lambda number: task.held_out(0)  # type: ignore[method-assign]
    Trainer(task, tmp_path, TrainingOptions(samples=140, batch=2, workers=0, held_out=1)).run()
    network = DetectorNet(4, SMALL)
    network.load_state_dict(task.network.state_dict())
    found = HeatmapModel.of(network, DEFAULT_CLASSES).find(an_image().image)
    assert sorted(element.class_id or 0 for element in found) == [POLE, RECTANGULAR]
    (pole,) = [element for element in found if element.class_id == POLE]
    assert pole.ends_px is not None
    assert np.abs(pole.ends_px[:, 0] - 101.0).max() < 4.0
    assert task.detector.threshold[ROUNDED] == 1.0  # there was none to choose it by


def test_an_image_of_any_size_is_looked_at() -> None:
    model = HeatmapModel.of(DetectorNet(4), DEFAULT_CLASSES)
    for shape in ((1, 1, 3), (33, 47, 3), (376, 1241, 3)):
        assert model.find(np.zeros(shape, np.uint8)) == []
    with pytest.raises(SemvizError, match=r"shape \(5, 5\)"):
        model.find(np.zeros((5, 5), np.uint8))


def test_folded_networks_answer_alike() -> None:
    torch.manual_seed(1)
    network = DetectorNet(4)
    image = torch.randint(0, 256, (2, 64, 96, 3), dtype=torch.uint8)
    network.train()
    network(image)
    network.eval()
    with torch.no_grad():
        before = network(image)
        torch.testing.assert_close(network.folded()(image), before, rtol=1e-3, atol=1e-3)


def test_thresholds_keep_what_is_false_within_the_limit() -> None:
    """A model with all false positives below 0.5; regions score above."""

    class Planted(HeatmapModel):
        def find(self, image: np.ndarray, watch: object = None) -> list[Region]:
            right = Region(RECTANGULAR, 0.8, np.array([200.0, 100, 240, 140]))
            false = [
                Region(RECTANGULAR, 0.4 + 0.01 * k, np.array([20.0 * k, 340, 20.0 * k + 15, 355]))
                for k in range(1, 5)
            ]
            threshold = float(self.threshold[RECTANGULAR])
            return [region for region in (right, *false) if region.score >= threshold]

    model = Planted(DetectorNet(4), DEFAULT_CLASSES, np.full(4, 0.3))
    threshold = chosen_thresholds(model, [an_image()] * 4,
                                  DEFAULT_CLASSES)  # fmt: skip
    assert 0.45 < threshold[RECTANGULAR] <= 0.8
    assert threshold[POLE] == 1.0


def test_images_of_each_kind_come_in_turn() -> None:
    other = replace(an_image(), regions=None)
    joined = ConcatImages((Images(an_image(), 5), Images(other, 2, 3)))
    assert joined.count == 10
    assert joined.held_out_count == 6
    has_masks = [joined.image(row).regions is not None for row in range(joined.count)]
    assert has_masks == [True, False] * 5


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        (NetworkWeights("verifier", {"classes": []}, {}), "weights of verifier"),
        (NetworkWeights("detector", {"classes": ["lamp"]}, {}), "trained for the classes lamp"),
        (
            NetworkWeights(
                "detector", {"classes": [class_.name for class_ in DEFAULT_CLASSES]}, {}
            ),
            "of another version",
        ),
    ],
)
def test_other_weights_are_refused_in_one_line(
    weights: NetworkWeights, told: str, tmp_path: Path
) -> None:
    path = tmp_path / "detector.safetensors"
    weights.save(path)
    with pytest.raises(SemvizError, match=told) as error:
        load_shipped_model(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_lower_score_finds_what_the_thresholds_of_training_leave_out() -> None:
    torch.manual_seed(0)
    strict = replace(
        HeatmapModel.of(DetectorNet(4), DEFAULT_CLASSES), threshold=np.array([1.0, 1.0, 1.0, 1.0])
    )
    image = an_image().image
    assert not strict.find(image)
    found = strict.from_score(1e-3).find(image)
    assert found
    assert min(region.score for region in found) >= 1e-3
    assert strict.threshold.min() == 1.0

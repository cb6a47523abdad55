"""How well ends of poles and signs are measured: on rendered streets and on labelled real images.

    OMP_NUM_THREADS=1 python bench/measuring.py                             rendered streets
    OMP_NUM_THREADS=1 python bench/measuring.py --kitti /data/kitti --model espnet.toml

Streets are held out. Their regions are a segmenter's masks that end early, the same with leaves
before ends, masks of what is no sign, and those of the shipped network. Real images are those of
KITTI odometry 02, frames 0 to 19, left and right, with the labels of docs/kitti02; their detections
are linked, too. Times are processor time. To compare two versions of semviz, run it with each.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from time import thread_time
from typing import NamedTuple

import cv2
import numpy as np
from subpixel_regions import false_masks, masked_in_part, overgrown, shown

from semviz.research.detector_evaluation import labelled_images
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.association.detection_tracks import TrackOptions, detection_labels
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.jit import Result, Stopwatch
from semviz_core.detection.detector import RegionModel, load_region_model, measure
from semviz_core.detection.regions import Region
from semviz_core.metrics.detection import HELD_OUT_SEED, ImageGroundTruth, match_detections
from semviz_core.subpixel.sampling import SampledImage

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
FAR_PX = 10.0
REACH_M = 200.0


class ProcessorWatch(Stopwatch):
    """Processor time of stages, of one thread."""

    def time(self, stage: str, action: Callable[[], Result]) -> Result:
        start = thread_time()
        result = action()
        self.time_ms[stage] = (thread_time() - start) * 1e3
        return result


class Measured(NamedTuple):
    """One image."""

    elements: Elements2D
    truth: ImageGroundTruth
    watch: Stopwatch


def measured(
    image: SampledImage, regions: Sequence[Region], truth: ImageGroundTruth, watch: Stopwatch
) -> Measured:
    return Measured(watch.time("measuring", lambda: measure(image, regions)), truth, watch)


def on_streets(streets: int, model: RegionModel) -> dict[str, list[Measured]]:
    """By what made the regions."""
    of: dict[str, list[Measured]] = {
        name: [] for name in ("masks that end early", "leaves before ends", "no signs", model.name)
    }
    for view in shown(range(HELD_OUT_SEED, HELD_OUT_SEED + streets)):
        leafy = overgrown(view)
        given = [
            (view, masked_in_part(view)[0]),
            (leafy, masked_in_part(leafy)[0]),
            (view, false_masks(view)),
            (view, list(model.find(view.picture.image))),
        ]
        for name, (where, regions) in zip(of, given, strict=True):
            of[name].append(measured(where.picture, regions, where.truth, ProcessorWatch()))
    return of


def on_kitti(kitti: Path, model: RegionModel) -> list[Measured]:
    images: list[Measured] = []
    detections: list[Proposal] = []
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace.create_kitti(Path(folder) / "town", kitti, "02", (2, 3), range(20))
        with workspace.open_labels() as store:
            import_operations(LABELS, store)
        for image in labelled_images(workspace, None, ("left", "right"), REACH_M):
            picture, watch = image.read(), ProcessorWatch()
            regions = model.find(picture, watch)
            images.append(measured(SampledImage(picture), regions, image.truth(), watch))
            detections += as_proposals(
                image.frame_index, image.side, images[-1].elements, workspace.source.rig.left, ""
            )
        for _ in range(2):  # the first time compiles
            linking_ms = linked_ms(workspace, Proposals.of(detections)) / len(images)
        for measured_image in images:
            measured_image.watch.time_ms["linking"] = linking_ms
    return images


def linked_ms(workspace: Workspace, detections: Proposals) -> float:
    """Return how long all detections of a drive take to be linked."""
    watch, labels = ProcessorWatch(), Labels(triangle_center=detections.triangle_center)
    source, link, options = workspace.source, LinkOptions(), TrackOptions()
    watch.time("linking", lambda: detection_labels(labels, detections, source, link, options))
    return watch.time_ms["linking"]


class Ends(NamedTuple):
    """Peaks or bottoms of the poles found."""

    error_px: FloatArray
    sigma_px: FloatArray
    """Of those that are known, and said to be."""
    known: BoolArray
    truly_known: BoolArray


def ends(images: Iterable[Measured], which: int) -> Ends:
    rows: list[tuple[float, float, bool, bool]] = []
    for image in images:
        found, truth = image.elements, image.truth.elements
        for row, true in enumerate(match_detections(found, image.truth).tolist()):
            if true < 0 or not found.is_line[row]:
                continue
            true_px = np.stack([truth.anchor_px[true], truth.end_px[true]])
            along = (true_px[1] - true_px[0]) / np.linalg.norm(true_px[1] - true_px[0])
            place = (found.anchor_px, found.end_px)[which][row]
            said = (found.anchor_known, found.end_known)[which][row]
            known = (truth.anchor_known, truth.end_known)[which][true]
            off = float((place - true_px[which]) @ along)
            rows.append((off, float(found.sigma_px[row, 1]), bool(said), bool(known)))
    errors, sigmas, said_all, known_all = (np.array(column) for column in zip(*rows, strict=True))
    both = said_all & known_all
    return Ends(errors[both], sigmas[both], said_all, known_all)


def print_ends(name: str, found: Ends) -> None:
    error = np.abs(found.error_px)
    ratio = error / found.sigma_px
    print(
        f"  {name}: {len(error)}, median {np.median(error):.2f} px, over {FAR_PX:g} px "
        f"{np.mean(error > FAR_PX):.1%} (most {error.max():.0f}); error/sigma RMS "
        f"{np.sqrt((ratio**2).mean()):.2f}, over 3 {np.mean(ratio > 3.0):.1%}; sigma median "
        f"{np.median(found.sigma_px):.1f} px"
    )
    shares = [
        f"{np.mean(found.known[which]):.0%} of {which.sum()}" if which.any() else "none"
        for which in (found.truly_known, ~found.truly_known)
    ]
    print(f"    said to be known: {shares[0]} known ones, {shares[1]} hidden ones")


def print_signs(images: Sequence[Measured]) -> None:
    found = right = false = there = placed = 0
    by_class = np.zeros(4, np.int64)
    for image in images:
        signs = image.elements[~image.elements.is_line]
        rows = match_detections(signs, image.truth)
        elements = image.truth.elements
        shapeless = replace(image.truth, elements=replace(elements, class_id=1 - elements.is_line))
        any_class = replace(signs, class_id=np.ones(len(signs), np.int64))
        by_class += np.bincount(signs.class_id, minlength=4)[:4]
        found, right = found + len(signs), right + int((rows >= 0).sum())
        false += int((rows == -1).sum())
        placed += int((match_detections(any_class, shapeless) >= 0).sum())
        there += int((image.truth.counts & ~elements.is_line).sum())
    print(
        f"  signs: {found} ({', '.join(map(str, by_class[1:]))} triangular, rectangular, rounded), "
        f"of {there} {placed} found, {right} with their class; {false} false"
    )


def print_figures(name: str, images: Sequence[Measured]) -> None:
    print(f"\n{name}: {len(images)} images")
    for which, end in enumerate(("peaks", "bottoms")):
        if any(image.elements.is_line.any() for image in images):
            print_ends(end, ends(images, which))
    print_signs(images)
    for stage in images[0].watch.time_ms:
        times = np.array([image.watch.time_ms[stage] for image in images])
        print(f"  {stage}: median {np.median(times):.1f} ms, most {times.max():.0f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", type=Path, help="KITTI odometry's folder: real images instead")
    parser.add_argument("--model", help="as of 'semviz detect'")
    parser.add_argument("--streets", type=int, default=12)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    model = load_region_model(arguments.model)
    if arguments.kitti is not None:
        print_figures(f"KITTI 02, {model.name}", on_kitti(arguments.kitti, model))
        return
    for name, images in on_streets(arguments.streets, model).items():
        print_figures(name, images)


if __name__ == "__main__":
    main()

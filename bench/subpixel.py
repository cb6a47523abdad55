"""Accuracy of elements measured in regions, and calibration of their sigmas, on rendered streets.

    python bench/subpixel.py [--quick] [--plot PNG]    figures, on streets held out
    python bench/subpixel.py --planted                 without the network's regions
    python bench/subpixel.py --fit                     the weights of semviz_core.detection.regions

Regions are of three kinds: true ones that are off as a network's are (ends by px, masks grown,
shrunk, coarse or with holes, some without ends or mask), a segmenter's masks that end early, and
those that the shipped network finds.
Both ways of measuring get the same regions, those of elements that count.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import NamedTuple

import cv2
import numpy as np
from subpixel_fit import Errors, Regions, errors_px, fit
from subpixel_regions import FRAMES, found, masked_in_part, planted, shown

from semviz.presentation.plots import add_grid, add_legend, line_style, new_figure, plain_numbers
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.detection.detector import MeasureRegion, by_edges, load_region_model, measure
from semviz_core.metrics.detection import HELD_OUT_SEED, match_detections
from semviz_core.research.paper.method import measure_as_in_paper

TUNING_SEED = 20_000
WAYS: dict[str, MeasureRegion] = {"edges": by_edges, "paper": measure_as_in_paper}
BINS = 7


class Answer(NamedTuple):
    """One element that was measured."""

    is_pole: bool
    errors: Errors
    sigma_px: FloatArray
    """(2,)"""
    known: BoolArray
    """(2,)"""
    truly_known: BoolArray
    class_right: bool


class Answers(NamedTuple):
    """Of all images."""

    rows: list[Answer]
    regions: int
    ms: float
    """Processor time for a region, median over images."""


def answers(images: Regions, way: str) -> Answers:
    """What was measured, beside the element that it is by the rule of evaluation."""
    rows: list[Answer] = []
    times = []
    for image, regions, _ in images:
        begin = process_time()
        elements = measure(image.picture, regions, WAYS[way])
        times.append(1e3 * (process_time() - begin) / max(1, len(regions)))
        truth = image.whole.elements
        anonymous = replace(image.truth, elements=replace(truth, class_id=1 - truth.is_line))
        for row, true in enumerate(
            match_detections(replace(elements, class_id=1 - elements.is_line), anonymous)
        ):
            if true >= 0:
                rows.append(_answer(elements, truth, row, int(true)))
    return Answers(rows, sum(len(regions) for _, regions, _ in images), float(np.median(times)))


def _answer(elements: Elements2D, truth: Elements2D, row: int, true: int) -> Answer:
    return Answer(
        bool(elements.is_line[row]),
        errors_px(elements, truth, row, true),
        elements.sigma_px[row],
        np.array([elements.anchor_known[row], elements.end_known[row]]),
        np.array([truth.anchor_known[true], truth.end_known[true]]),
        bool(elements.class_id[row] == truth.class_id[true]),
    )


def print_table(name: str, way: str, of: Answers) -> None:
    poles = [row for row in of.rows if row.is_pole]
    signs = [row for row in of.rows if not row.is_pole]
    across = _joined(pole.errors.across for pole in poles)
    along = _joined(pole.errors.along for pole in poles)
    angles = np.array([pole.errors.angle_deg for pole in poles])
    middles = np.array([np.hypot(*sign.errors.across) for sign in signs])
    flags = np.mean([pole.known == pole.truly_known for pole in poles], axis=0)
    print(f"\n{name}, {way}: {len(of.rows)} of {of.regions} regions, {of.ms:.1f} ms for each")
    print(
        f"  poles {len(poles):>4}: {_spread(angles, 'deg')} angle; {_spread(across, 'px')} across"
    )
    print(f"    {_spread(along, 'px')} along at {len(along)} known ends")
    print(f"    flag right: peaks {flags[0]:.1%}, bottoms {flags[1]:.1%}")
    print(f"  signs {len(signs):>4}: {_spread(middles, 'px')} of the middle")
    print(f"    class right {np.mean([sign.class_right for sign in signs]):.1%}")


def _spread(errors: FloatArray, unit: str) -> str:
    p50, p95 = np.percentile(np.abs(errors), (50, 95))
    return f"RMSE {np.sqrt((errors**2).mean()):.2f} {unit} (median {p50:.2f}, p95 {p95:.2f})"


def _joined(parts: Iterable[FloatArray]) -> FloatArray:
    return np.concatenate([np.zeros(0), *parts])


def said_and_true(of: Answers) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Of poles across and along, and of signs: predicted sigmas, and errors, one for each."""
    pairs: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in of.rows:
        what = "poles, across" if row.is_pole else "signs"
        pairs[what] += [(float(row.sigma_px[0]), float(off)) for off in row.errors.across]
        pairs["poles, along"] += [(float(row.sigma_px[1]), float(off)) for off in row.errors.along]
    return {what: (np.array(rows)[:, 0], np.array(rows)[:, 1]) for what, rows in pairs.items()}


def binned(sigma_px: FloatArray, error_px: FloatArray) -> list[tuple[float, float, int]]:
    """Bins of as many each: the RMS of sigma, the RMS of errors, how many."""
    parts = np.array_split(np.argsort(sigma_px, kind="stable"), BINS)
    return [(_rms(sigma_px[part]), _rms(error_px[part]), len(part)) for part in parts]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def print_calibration(of: Answers) -> None:
    for what, (sigma_px, error_px) in said_and_true(of).items():
        bins = binned(sigma_px, error_px)
        print(f"  {what}: said {_rms(sigma_px):.2f}, true {_rms(error_px):.2f} px; in bins")
        print("    " + "  ".join(f"{said:.2f}:{true:.2f}" for said, true, _ in bins))


def plot(path: Path, all_answers: dict[str, Answers]) -> None:
    """Predicted against true, one panel for each kind of regions."""
    figure = new_figure(9.0, 3.6)
    panels = figure.subplots(1, len(all_answers), sharex=True, sharey=True, squeeze=False)[0]
    for axis, (name, of) in zip(panels, all_answers.items(), strict=True):
        axis.set(title=name, xlabel="said (px)", xscale="log", yscale="log")
        axis.plot([0.1, 10.0], [0.1, 10.0], color="0.6", linewidth=0.8, linestyle="--")
        for number, (what, pairs) in enumerate(said_and_true(of).items()):
            said, true, _ = zip(*binned(*pairs), strict=True)
            axis.plot(said, true, marker="os^"[number], label=what, **line_style(number))
        add_grid(axis)
        plain_numbers(axis.xaxis, axis.yaxis)
    panels[0].set_ylabel("RMS of errors (px)")
    add_legend(figure)
    figure.savefig(path, dpi=110)


def images_of(seeds: range, model: str | None, with_model: bool) -> dict[str, Regions]:
    """By what made the regions."""
    finder = load_region_model(model, DEFAULT_CLASSES) if with_model else None
    result: dict[str, Regions] = defaultdict(list)
    for view in shown(seeds):
        result["planted"].append((view, *planted(view)))
        result["early masks"].append((view, *masked_in_part(view)))
        if finder is not None:
            result[finder.name].append((view, *found(view, finder)))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four streets instead of 25")
    parser.add_argument("--fit", action="store_true", help="fit the weights instead")
    parser.add_argument("--planted", action="store_true", help="no network's regions")
    parser.add_argument("--model", help="another than the network that ships")
    parser.add_argument("--plot", type=Path, help="write the plot of sigmas here")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    first = TUNING_SEED if arguments.fit else HELD_OUT_SEED
    seeds = range(first, first + (4 if arguments.quick else 12 if arguments.fit else 25))
    print(f"rendered streets, seeds {seeds[0]} to {seeds[-1]}, frames {FRAMES}, left images")
    images = images_of(seeds, arguments.model, not arguments.planted)
    if arguments.fit:
        print(fit([image for every in images.values() for image in every]))
        return
    of_edges: dict[str, Answers] = {}
    for name, regions in images.items():
        for way in WAYS:
            of = answers(regions, way)
            print_table(f"{name} regions", way, of)
            print_calibration(of)
            if way == "edges":
                of_edges[name] = of
    if arguments.plot is not None:
        plot(arguments.plot, of_edges)


if __name__ == "__main__":
    main()

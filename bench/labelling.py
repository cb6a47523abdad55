"""Inputs per label: a scripted annotator labels 8 frames of simulated streets.

    python bench/labelling.py
    python bench/labelling.py --detector own        after 'semviz detect'
    python bench/labelling.py --detector simulated  one as good as the paper's
    python bench/labelling.py --every-frame         without key frames and the filmstrip
    python bench/labelling.py --each --tremor 0     what each input was for; a hand that hits all
    python bench/labelling.py --kitti /data/kitti   real images too: KITTI 02 with our own labels

The script labels every pole and sign up to 40 m ahead that is visible in both images, by the
street's truth. Its clicks have an error of 1.5 CSS pixels, at the zoom that shows the whole image,
with snapping on. It accepts a proposal if both marks are right, rejects it otherwise, and draws
elements without a proposal. Every fifth frame is labelled first; the frames between follow in the
filmstrip, where it leaves out or drags what is wrong. It presses a class key only where the page
would draw another class, and after zooming in looks for the whole pole again. The page counts
inputs: a key, a click or a turn of the wheel is one, a drag two. At the end every label is
compared with the truth.

Times are those of the keystroke-level model (Card, Moran & Newell 1980) with its own constants, for
an average typist: a key 0.28 s, a click 0.2 s, pointing 1.1 s, and a thought of 1.35 s before each
drawing, before each correction and once a frame.
"""

import argparse
import subprocess
import tempfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from drives import KITTI_FRAMES, SIDES, Drive, KittiDrive, StreetDrive
from labelling_driver import Labeller
from labelling_hand import TREMOR_CSS_PX, Work
from labelling_truth import RIGHT_PX, errors_px, flags_right
from playwright.sync_api import Page, sync_playwright

from semviz.annotator.server import Annotator
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.simulation.detector import SimulatedDetector

CHROMIUM = ["--no-sandbox", "--enable-unsafe-swiftshader"]
FRAMES = 8
STRIDE = 5
"""Of key frames, as the page has it."""
PATIENCE_MS = 300_000
"""On a busy machine."""
BY_HAND = """
Inputs that a pole in both images of a frame needs, counted by its steps (other tools were not run):
  each image by itself (labelme, CVAT):   5 and more: class, two clicks in each image; not linked
  linked by hand afterwards:              6 and more: the same, and a key to link them
  semviz, both by hand:                   5: class, two clicks in each image; linked by the rays
  semviz, first frame:                    2: class, one click where the whole pole is shown, else
                                             two; the frame's key takes its partner
  semviz, later frames:                   none of its own: the frame's key takes it
"""


def simulated_proposals(workspace: Workspace, seed: int) -> None:
    """What a detector as good as the paper's would propose for both images of each frame."""
    street = workspace.street
    detector = SimulatedDetector(street, "paper", seed)
    found = [
        proposal
        for index in range(FRAMES)
        for side in SIDES
        for proposal in as_proposals(
            index,
            side,
            detector.detect(index, side).observed,
            street.rig.left,
            "simulated",
            "centroid",
        )
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)


@dataclass(frozen=True)
class Way:
    """How the script labels."""

    stride: int
    """Of key frames; 1: every frame, without the filmstrip."""
    tremor_css_px: float


@dataclass(frozen=True)
class Outcome:
    """What labelling a drive cost, and what came out."""

    name: str
    frames: int
    labeller: Labeller
    errors_px: dict[int, list[float]]
    """By class."""
    ends_right: tuple[float, float]
    said: str
    """The page's own count."""


def run_street(
    seed: int, folder: Path, browser: Any, detector: str, model: str | None, way: Way
) -> Outcome:
    workspace = Workspace.create_street(folder / f"street-{seed}", seed, range(FRAMES))
    if detector == "simulated":
        simulated_proposals(workspace, seed)
    elif detector == "own":
        which = [] if model is None else ["--model", model]
        subprocess.run(["semviz", "detect", str(workspace.path), *which], check=True)
    return run(workspace, StreetDrive(workspace.street), FRAMES, browser, seed, way)


def run_kitti(kitti: Path, frames: int, folder: Path, browser: Any, hand: int, way: Way) -> Outcome:
    path = folder / f"kitti-02-{hand}"
    workspace = Workspace.create_kitti(path, kitti, "02", (2, 3), KITTI_FRAMES[:frames])
    return run(workspace, KittiDrive.of(kitti), frames, browser, hand, way)


def label_all(page: Page, labeller: Labeller, frames: int, stride: int) -> None:
    """Labels every frame, or key frames and the filmstrips between them."""
    if stride == 1:
        for frame in range(frames):
            labeller.label(frame)
        return
    labeller.key("Shift+E")
    before = -1
    while before < frames - 1:
        frame = min(before + stride, frames - 1) if before >= 0 else 0
        labeller.label(frame)
        if frame > before + 1:
            labeller.label_between(range(before + 1, frame))
        before = frame


def run(
    workspace: Workspace, drive: Drive, frames: int, browser: Any, seed: int, way: Way
) -> Outcome:
    annotator = Annotator(workspace, author="script")
    try:
        with Gateway(annotator).running() as url:
            page = browser.new_page(viewport={"width": 1600, "height": 950})
            page.set_default_timeout(PATIENCE_MS)
            page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
            page.goto(url)
            page.wait_for_selector("#saved.saved")
            page.keyboard.press("f")  # the 3D pane: slow without a graphics card
            labeller = Labeller(page, annotator, drive, seed, way.tremor_css_px)
            label_all(page, labeller, frames, way.stride)
            said = page.get_attribute("#effort", "title") or ""
            page.close()
        made = annotator.session.labels
        errors = errors_px(made, drive)
        return Outcome(workspace.name, frames, labeller, errors, flags_right(made, drive), said)
    finally:
        annotator.close()


def print_causes(works: Sequence[Work], labels: int) -> None:
    """What the inputs were for, the dearest first: in all, of first and of later sightings, of
    poles, of signs and of whole frames."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for work in works:
        for step in work.spent:
            of = "frame" if step.class_id is None else DEFAULT_CLASSES[step.class_id].kind
            when = "first" if work.is_first(step) else "later"
            for column in ("inputs", when, of):
                counts[step.cause][column] += step.inputs
            counts[step.cause]["times"] += step.inputs > 0
    columns = ("times", "inputs", "first", "later", "line", "point", "frame")
    print(f"{'inputs for':46s}{''.join(f'{each:>7s}' for each in columns)}  each observation")
    for cause, row in sorted(counts.items(), key=lambda each: -each[1]["inputs"]):
        if row["inputs"]:
            shown = "".join(f"{row[each]:7d}" for each in columns)
            print(f"  {cause:44s}{shown} {row['inputs'] / labels:10.3f}")


def print_outcome(outcome: Outcome) -> None:
    work = outcome.labeller.work
    errors = [error for each in outcome.errors_px.values() for error in each]
    right = [error for error in errors if error <= RIGHT_PX]
    print(
        f"{outcome.name}: {len(errors)} observations in {outcome.frames} frames, "
        f"{work.inputs / len(errors):.3f} inputs each ({work.keys} keys, {work.clicks} "
        f"clicks), {work.seconds:.0f} s; {len(right) / len(errors):.1%} within "
        f"{RIGHT_PX:g} px, median {np.median(right):.2f} px"
    )
    for class_id, each in sorted(outcome.errors_px.items()):
        share = np.mean([error <= RIGHT_PX for error in each])
        print(f"  {DEFAULT_CLASSES[class_id].name:<17} {len(each):>4}: {share:.1%}")
    first, later = outcome.labeller.work.inputs_by_sighting()
    print(f"  inputs for a first sighting {first:.2f} (goal 2.5), a later one {later:.2f} (0.2)")
    print(f"  keys: {dict(work.pressed)}")
    ends = outcome.ends_right
    print(
        f"  the first drawings and the frames' keys alone: {work.least / len(errors):.3f}; "
        f"ends that are seen and are said to be: {ends[0]:.1%}, hidden ones: {ends[1]:.1%}"
    )
    print(f"  the page's own count since it was opened: {outcome.said}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[1001, 1002, 1003])
    parser.add_argument("--detector", choices=["none", "simulated", "own"], default="none")
    parser.add_argument("--model", help="of --detector own, as 'semviz detect' takes it")
    parser.add_argument("--each", action="store_true", help="what each input was for")
    parser.add_argument("--frames", type=int, default=len(KITTI_FRAMES), help="of KITTI 02")
    parser.add_argument("--every-frame", action="store_true", help="without the filmstrip")
    parser.add_argument(
        "--tremor", type=float, default=TREMOR_CSS_PX, help="error of a click, CSS pixels; 0: none"
    )
    parser.add_argument("--hands", type=int, default=4, help="that label KITTI 02")
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry: label 02 as well")
    arguments = parser.parse_args()
    outcomes: list[Outcome] = []
    way = Way(1 if arguments.every_frame else STRIDE, arguments.tremor)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as name:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        folder = Path(name)
        for seed in arguments.seeds:
            outcomes.append(
                run_street(seed, folder, browser, arguments.detector, arguments.model, way)
            )
            print_outcome(outcomes[-1])
        if arguments.kitti is not None:
            for hand in range(arguments.hands):
                of = arguments.kitti, arguments.frames, folder, browser
                outcomes.append(run_kitti(*of, hand, way))
                print_outcome(outcomes[-1])
    if arguments.each:
        for step in [step for outcome in outcomes for step in outcome.labeller.work.spent]:
            print(f"    frame {step.frame}: {step.inputs} for {step.cause}; {step.about}")
    print_sum(outcomes)
    print(BY_HAND)


def print_sum(outcomes: list[Outcome]) -> None:
    works = [outcome.labeller.work for outcome in outcomes]
    labels = sum(len(each) for outcome in outcomes for each in outcome.errors_px.values())
    spent = [step for work in works for step in work.spent]
    inputs, least = sum(step.inputs for step in spent), sum(work.least for work in works)
    print(f"all: {inputs / labels:.3f} inputs per observation (goal 0.2); ", end="")
    print(f"the first drawings and the frames' keys alone {least / labels:.3f}")
    sightings = [outcome.labeller.work.inputs_by_sighting() for outcome in outcomes]
    first, later = np.mean(sightings, axis=0)
    print(f"mean of the drives: a first sighting {first:.2f} (2.5), a later one {later:.2f} (0.2)")
    minutes = sum(work.seconds for work in works) / (labels / 2) * 1000 / 60
    print(f"1,000 stereo observations: {minutes:.1f} min (goal 20)")
    print_causes(works, labels)


if __name__ == "__main__":
    main()

"""Inputs per label: a scripted annotator labels 8 frames of simulated streets.

    python bench/labelling.py
    python bench/labelling.py --detector own        after 'semviz detect'
    python bench/labelling.py --detector simulated  one as good as the paper's

The script labels every pole and sign up to 40 m ahead that is visible in both images, by the
street's truth. Its clicks have an error of 1.5 CSS pixels, at the zoom that shows the whole image,
with snapping on. It accepts a proposal if both marks are right, rejects it otherwise, and draws
elements without a proposal. The page counts inputs: a key, a click or a turn of the wheel is one, a
drag two. At the end every label is compared with the truth.

Times are those of the keystroke-level model (Card, Moran & Newell 1980) with its own constants, for
an average typist: a key 0.28 s, a click 0.2 s, pointing 1.1 s, and a thought of 1.35 s before each
drawing, before each correction and once a frame.
"""

import argparse
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from labelling_driver import Labeller, Spent, Work
from labelling_truth import RIGHT_PX, SIDES, errors_px, flags_right
from playwright.sync_api import sync_playwright

from semviz.annotator.server import Annotator
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_core.simulation.detector import SimulatedDetector

CHROMIUM = ["--no-sandbox", "--enable-unsafe-swiftshader"]
FRAMES = 8
PATIENCE_MS = 300_000
"""On a busy machine."""
BY_HAND = """
Inputs that a pole in both images of a frame needs, counted by its steps (other tools were not run):
  each image by itself (labelme, CVAT):   5 and more: class, two clicks in each image; not linked
  linked by hand afterwards:              6 and more: the same, and a key to link them
  semviz, both by hand:                   5: class, two clicks in each image; linked by the rays
  semviz, first frame:                    3: class, two clicks; the frame's key takes its partner
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


def run(
    seed: int, folder: Path, browser: Any, detector: str, model: str | None
) -> tuple[Work, list[float], tuple[float, float], str]:
    workspace = Workspace.create_street(folder / f"street-{seed}", seed, range(FRAMES))
    if detector == "simulated":
        simulated_proposals(workspace, seed)
    elif detector == "own":
        which = [] if model is None else ["--model", model]
        subprocess.run(["semviz", "detect", str(workspace.path), *which], check=True)
    annotator = Annotator(workspace, author="script")
    street = workspace.street
    try:
        with Gateway(annotator).running() as url:
            page = browser.new_page(viewport={"width": 1600, "height": 950})
            page.set_default_timeout(PATIENCE_MS)
            page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
            page.goto(url)
            page.wait_for_selector("#saved.saved")
            page.keyboard.press("f")  # the 3D pane: slow without a graphics card
            labeller = Labeller(page, annotator, street, seed)
            for frame in range(FRAMES):
                labeller.label(frame)
            said = page.get_attribute("#effort", "title")
            page.close()
        made = annotator.session.labels
        return labeller.work, errors_px(made, street), flags_right(made, street), said
    finally:
        annotator.close()


def print_causes(spent: list[Spent], labels: int) -> None:
    """What the inputs were for, the dearest first."""
    inputs: Counter[str] = Counter()
    times: Counter[str] = Counter()
    for step in spent:
        inputs[step.cause] += step.inputs
        times[step.cause] += step.inputs > 0
    print(f"{'inputs for':50s} times  inputs  each observation")
    for cause, count in inputs.most_common():
        if count:
            print(f"  {cause:48s} {times[cause]:5d} {count:7d} {count / labels:10.3f}")


def print_street(
    seed: int, work: Work, errors: list[float], flags: tuple[float, float], said: str
) -> None:
    right = [error for error in errors if error <= RIGHT_PX]
    print(
        f"street {seed}: {len(errors)} observations in {FRAMES} frames, "
        f"{work.inputs / len(errors):.3f} inputs each ({work.keys} keys, {work.clicks} "
        f"clicks), {work.seconds:.0f} s; {len(right) / len(errors):.1%} within "
        f"{RIGHT_PX:g} px, median {np.median(right):.2f} px"
    )
    print(f"  keys: {dict(work.pressed)}")
    print(
        f"  the first drawings and the frames' keys alone: {work.least / len(errors):.3f}; "
        f"ends that are seen and are said to be: {flags[0]:.1%}, hidden ones: {flags[1]:.1%}"
    )
    print(f"  the page's own count since it was opened: {said}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1001, 1002, 1003])
    parser.add_argument("--detector", choices=["none", "simulated", "own"], default="none")
    parser.add_argument("--model", help="of --detector own, as 'semviz detect' takes it")
    parser.add_argument("--each", action="store_true", help="what each input was for")
    arguments = parser.parse_args()
    labels, seconds, least = 0, 0.0, 0
    spent: list[Spent] = []
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        for seed in arguments.seeds:
            work, errors, flags, said = run(
                seed, Path(folder), browser, arguments.detector, arguments.model
            )
            print_street(seed, work, errors, flags, said)
            if arguments.each:
                for step in work.spent:
                    print(f"    frame {step.frame}: {step.inputs} for {step.cause}; {step.about}")
            spent += work.spent
            labels, least = labels + len(errors), least + work.least
            seconds += work.seconds
    inputs = sum(step.inputs for step in spent)
    print(f"all: {inputs / labels:.3f} inputs per observation (goal 0.2); ", end="")
    print(f"the first drawings and the frames' keys alone {least / labels:.3f}")
    pairs = labels / 2
    print(f"1,000 stereo observations: {seconds / pairs * 1000 / 60:.1f} min (goal 20)")
    print_causes(spent, labels)
    print(BY_HAND)


if __name__ == "__main__":
    main()

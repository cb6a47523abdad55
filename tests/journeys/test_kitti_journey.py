"""The whole thread on real images: label in the page, build the map, localize, measure, look."""

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from journeys.driver import LabelDriver
from serving import serving

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels, StereoPair
from semviz_annotation.storage.backup import import_operations
from semviz_annotation.storage.store import LabelStore

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [pytest.mark.browser, pytest.mark.realdata, pytest.mark.timeout(600)]

OUR_LABELS = Path(__file__).parents[2] / "docs" / "kitti02" / "labels.jsonl"
MAPPED, LOCALIZED = 5, 6
ELEMENTS = 6


SEMVIZ = (sys.executable, "-m", "semviz.cli")


def semviz(*arguments: object, environment: dict[str, str]) -> str:
    command = [*SEMVIZ, *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def to_click(tmp_path: Path) -> Labels:
    """Where a careful person clicked before."""
    with LabelStore.open(tmp_path / "ours.db") as store:
        import_operations(OUR_LABELS, store)
        return store.labels


def nearest(labels: Labels) -> list[StereoPair]:
    """The elements in both frames that are nearest by their disparity."""
    later = {pair.element.id for pair in labels.pairs(LOCALIZED)}
    pairs = [pair for pair in labels.pairs(MAPPED) if pair.element.id in later]
    pairs.sort(key=lambda pair: pair.right.anchor_px[0] - pair.left.anchor_px[0])
    return pairs[:ELEMENTS]


def draw(driver: LabelDriver, pair: StereoPair, element: str | None) -> str:
    name = element
    for row in (pair.left, pair.right):
        if row.end_px is None:
            name = driver.draw_sign(row.side, row.anchor_px, pair.element.class_id, name)
        else:
            known = (row.anchor_known, row.end_known)
            name = driver.draw_pole(row.side, row.anchor_px, row.end_px, name, *known)
    assert name is not None
    return name


def test_from_a_label_to_a_pose_on_screen(
    kitti_root: Path, tmp_path: Path, environment: dict[str, str], to_click: Labels, page: "Page"
) -> None:
    town, run = tmp_path / "town", tmp_path / "town" / "runs" / "first.rrd"
    source = ["--kitti", kitti_root, "--sequence", "02", "--cameras", "2,3"]
    semviz("new", town, *source, environment=environment)

    chosen = nearest(to_click)
    with serving([*SEMVIZ, "annotate", town], environment) as address:
        driver = LabelDriver(page)
        driver.open(address)
        driver.goto(MAPPED)
        names = {pair.element.id: draw(driver, pair, None) for pair in chosen}
        driver.goto(LOCALIZED)
        for pair in to_click.pairs(LOCALIZED):
            if pair.element.id in names:
                assert draw(driver, pair, names[pair.element.id]) == names[pair.element.id]
        drawn = driver.operation
        page.goto("about:blank")
    labels = Workspace.open(town).read_labels()
    assert labels.operation == drawn == 4 * ELEMENTS
    assert len(labels.elements) == ELEMENTS

    only_mapped = f"{MAPPED}:{MAPPED + 1}"
    assert f"{ELEMENTS} elements" in semviz(
        "map", "build", town, "--frames", only_mapped, environment=environment
    )
    frames = f"{LOCALIZED}:{LOCALIZED + 1}"
    semviz("localize", town, "--frames", frames, "--out", run, environment=environment)
    numbers = json.loads(semviz("evaluate", run, "--json", environment=environment))
    assert numbers["status"] == {"ok": 1, "ambiguous": 0, "cannot": 0}
    # One stereo pair places landmarks 2 % too far away on these images; see
    # docs/results/kitti02.md, where a map from ten frames gives 0.03 m.
    assert numbers["rte_m"]["q2"] < 0.8
    assert numbers["rre_deg"]["q2"] < 1.0

    with serving([*SEMVIZ, "serve", town], environment) as address:
        page.goto(address)
        page.wait_for_selector("#status:has-text('Ok')", timeout=60_000)
        shown = page.inner_text("#numbers")
        assert f"{numbers['rte_m']['q2']:.2f} m" in shown
        assert np.isclose(
            float(shown.split("·")[1].strip(" °")), numbers["rre_deg"]["q2"], atol=0.01
        )
        page.goto("about:blank")

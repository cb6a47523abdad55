"""rerun's own viewer opens a run, says nothing against it and shows what it should."""

import runpy
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import skip_or_fail

from semviz.presentation.plots import ESTIMATE
from semviz.runs.writer import RunWriter

BENCH = Path(__file__).parents[2] / "bench" / "recording.py"
DRIVERS = "/usr/share/vulkan/icd.d/lvp_icd*.json"
WAIT_S = 60.0


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames with the images of both cameras; 6 is ambiguous, 9 has no pose."""
    made_up = runpy.run_path(str(BENCH))
    path = tmp_path_factory.mktemp("runs") / "run.rrd"
    semantic_map = made_up["make_map"](length_m=80.0)
    jpeg = made_up["make_jpeg"]()
    info = replace(made_up["make_info"]("a run"), images="both")
    with RunWriter(path, info, semantic_map) as writer:
        for record in made_up["make_records"](semantic_map, 12, jpeg):
            writer.write(replace(record, image_right=jpeg))
    return path


@pytest.fixture(scope="module")
def viewer() -> Iterator[Any]:
    from rerun.experimental import ViewerClient

    drivers = sorted(Path("/").glob(DRIVERS[1:]))
    if not drivers:
        skip_or_fail(f"no software Vulkan ({DRIVERS}); install mesa-vulkan-drivers")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VK_DRIVER_FILES", str(drivers[0]))
        executable = str(Path(sys.executable).parent / "rerun")
        client = ViewerClient.spawn(
            headless=True, port=port, executable_path=executable, hide_welcome_screen=True
        )
    try:
        yield client
    finally:
        client.quit()


def orange_pixels(viewer: Any, frame: int) -> int:
    """How much of the 3D view has the colour of the estimate."""
    (view,) = [view for view in viewer.get_state().views if view.view_class == "3D"]
    viewer.set_time("frame", sequence=frame)
    until = time.monotonic() + WAIT_S
    while viewer.get_state().recordings[0].current_time != frame and time.monotonic() < until:
        time.sleep(0.1)
    time.sleep(1.0)  # software rendering
    png = np.frombuffer(viewer.take_screenshot(view.view_id), np.uint8)
    image = cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    orange = [int(ESTIMATE.dark[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(image - orange).max(axis=2) < 12).sum())


def test_the_viewer_shows_a_run_without_complaint(viewer: Any, run_file: Path) -> None:
    viewer.open(str(run_file))
    until = time.monotonic() + WAIT_S
    while viewer.get_state().loading and time.monotonic() < until:
        time.sleep(0.2)
    time.sleep(1.0)  # it first follows the end of what it loads
    assert orange_pixels(viewer, 5) > 100
    assert orange_pixels(viewer, 9) < 20, "a frame without a pose shows an estimate"
    state = viewer.get_state()
    names = {view.name for view in state.views if view.visible}
    shown = {"Map and poses", "Image", "Right image", "Match probability", "Why"}
    shown |= {"Error, m", "Error, deg", "Elements", "Status and diagnosis", "How to read this"}
    assert shown <= names
    assert [report for view in state.views for report in view.reports] == []
    bad = [log for log in viewer.get_logs() if log.level in ("WARN", "ERROR")]
    assert [error.message for error in bad if "Software rasterizer" not in error.message] == []

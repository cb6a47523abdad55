"""What several tests share: real data and a real browser.

Where either is missing a test skips with the reason; with SEMVIZ_REQUIRE_ALL=1 (CI) it fails.
"""

import gc
import importlib
import os
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import hypothesis
import platformdirs
import psutil
import pytest
from fonts import font_settings
from measured_once import images_measured_once
from streets import streets_painted_once

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Page

IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
if IS_WORKER:  # workers share the cores: more threads only wait
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# No deadline: machines are shared. Derandomized: a test fails or passes, whoever runs it.
hypothesis.settings.register_profile("semviz", deadline=None, derandomize=True)
hypothesis.settings.load_profile("semviz")

OPEN3D_NEEDS = ("libegl1", "libgl1", "libusb-1.0-0", "libx11-6")
"""Debian packages."""

REPOSITORY = Path(__file__).resolve().parents[1]
CHROMIUM_ARGS = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card; the rest is drawn without it
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # A browser window makes ready two pages of its own for the address bar: twice the time of a
    # test's page. The list replaces Playwright's, of which the rest is what pages could notice.
    "--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup,"
    "HttpsUpgrades,PaintHolding,OptimizationHints,MediaRouter,LensOverlay",
]


SLOWEST = (
    "test_docs",  # compiles the solver; those beside it need none
    "test_own_drive_checks", "test_detect_train", "test_own_drive_real", "test_own_drive_bags",
    "test_packaging", "test_own_drive", "test_annotator_page", "test_annotator_proposals",
    "test_inspector", "test_annotator_tracks_view", "test_kitti_journey", "test_rig_journey",
    "test_annotator_keys", "test_annotator_poses", "test_annotator_team", "test_pose_checks",
    "test_outputs", "test_pose_choices", "test_label_file_lost", "test_annotator_history",
    "test_backdrop_pages", "test_annotator_questions", "test_train", "test_page_limits",
)  # fmt: skip
"""Files of tests that take longest, which no worker must begin when the others are done."""
WORKER_BYTES = 2.5e9
"""Memory of a worker with its browser and what the networks' libraries load."""


def pytest_collection_finish() -> None:
    """What is imported by now stays; the garbage collector need not look through it again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads its option
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Let plain ``pytest`` use all cores; who names tests gets no workers.

    There are two more than cores: tests of pages wait a third of their time. A worker runs this
    hook as well, with no number of processes, and must start none.
    """
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS and not IS_WORKER
    asked = getattr(config.option, "numprocesses", 0) is not None or config.option.usepdb
    if whole and not asked:
        room = int(psutil.virtual_memory().available / WORKER_BYTES)
        config.option.numprocesses = min((psutil.cpu_count() or 1) + 2, max(room, 1))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest files; a worker takes a file at a time, in this order."""
    rank = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def skip_or_fail(reason: str) -> NoReturn:
    if os.environ.get("SEMVIZ_REQUIRE_ALL") == "1":
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@pytest.fixture(scope="session", autouse=True)
def _made_once() -> Iterator[None]:
    with streets_painted_once(), images_measured_once():
        yield


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    """A folder with KITTI odometry data: sequences/02 (frames 0-19) and poses/."""
    default = REPOSITORY.parent / "shared" / "data" / "kitti"
    root = Path(os.environ.get("SEMVIZ_KITTI", default))
    if not (root / "sequences" / "02" / "image_2").is_dir():
        skip_or_fail(f"no KITTI sequence 02 in {root}; set SEMVIZ_KITTI to the folder that has it")
    return root


@pytest.fixture(scope="session")
def drives() -> Path:
    """A folder with files of real drives."""
    default = REPOSITORY.parent / "shared" / "data" / "drives"
    root = Path(os.environ.get("SEMVIZ_DRIVES", default))
    if not (root / "utbm_stereo").is_dir():
        skip_or_fail(f"no drive utbm_stereo in {root}; set SEMVIZ_DRIVES to its folder")
    return root


@pytest.fixture(scope="session")
def kitti_pole_map(kitti_root: Path) -> Path:
    """Poles of sequence 02 that others surveyed by lidar, beside the KITTI folder."""
    path = kitti_root.parent / "pole_maps" / "kitti_02.npz"
    if not path.is_file():
        skip_or_fail(f"no pole map {path}")
    return path


@pytest.fixture(scope="session")
def open3d() -> Any:
    """Fuses backdrops, and clusters as the paper does. It needs libraries of the system."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        skip_or_fail(f"open3d cannot be imported ({error}); install {' '.join(OPEN3D_NEEDS)}")


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """For child processes: this Python's scripts first, and a cache folder of the tests' own.

    The demo is made there once for all tests, whichever process runs them. Only what is compiled is
    the user's own: it is the same, and takes a minute.
    """
    scripts = Path(sys.executable).parent
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    compiled = platformdirs.user_cache_path("semviz") / "compiled"
    compiled.mkdir(parents=True, exist_ok=True)
    cache = folder / "cache"
    (cache / "semviz").mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        (cache / "semviz" / "compiled").symlink_to(compiled, target_is_directory=True)
    return {
        **os.environ,
        "XDG_CACHE_HOME": str(cache),
        "PATH": f"{scripts}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "100",
    }


@pytest.fixture(scope="session")
def chromium_in(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], "Browser"]]:
    """A headless Chromium, the system's or Playwright's own, with one set of fonts."""
    try:
        from playwright import sync_api
    except ImportError:
        skip_or_fail("Playwright is not installed; pip install '.[test]' brings it")
    names = ("chromium", "chromium-browser", "google-chrome")
    system = next(filter(None, map(shutil.which, names)), None)
    folder = tmp_path_factory.mktemp("fonts")
    driver = sync_api.sync_playwright()
    try:
        playwright = driver.start()
    except Exception as error:
        skip_or_fail(f"Playwright does not start ({error}); install chromium and libatomic1")
    try:

        @cache
        def launched(fonts: str) -> "Browser":
            environment = {**os.environ, **font_settings(fonts, folder)}
            try:
                return playwright.chromium.launch(
                    executable_path=system, args=CHROMIUM_ARGS, env=environment
                )
            except sync_api.Error as error:
                said = error.message.splitlines()[0]
                skip_or_fail(f"no Chromium starts ({said}); install chromium")

        yield launched
    finally:
        playwright.stop()


@pytest.fixture(scope="session")
def chromium(chromium_in: Callable[[str], "Browser"]) -> "Browser":
    """The browser of all tests but those of layouts, which take each of ``FONTS``."""
    return chromium_in("wide")


@pytest.fixture
def fonts() -> str:
    """What ``page`` draws with; tests of layouts are parametrized by it."""
    return "wide"


@pytest.fixture
def page_errors() -> list[str]:
    """What the page complained of; a test that provokes errors clears those it expects."""
    return []


SERVER_ENDED = re.compile("WebSocket connection .*: net::ERR_CONNECTION_(REFUSED|RESET)$")
"""What Chromium says of a page that outlives its server, as many tests let it."""


@pytest.fixture
def page(
    chromium_in: Callable[[str], "Browser"], fonts: str, page_errors: list[str]
) -> Iterator["Page"]:
    """A fresh page, 1600x950. Errors in its console, or thrown in it, fail the test."""
    context = chromium_in(fonts).new_context(viewport={"width": 1600, "height": 950})
    page = context.new_page()

    def note(message: "ConsoleMessage") -> None:
        if message.type == "error" and not SERVER_ENDED.match(message.text):
            page_errors.append(f"{message.text} ({message.location.get('url', '')})")

    page.on("console", note)
    page.on("pageerror", lambda error: page_errors.append(str(error)))
    yield page
    context.close()
    assert not page_errors, "errors in the page:\n" + "\n".join(page_errors)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Address of a server that speaks the protocol of S3, and keeps its objects in memory."""
    try:
        server_of_moto = importlib.import_module("moto.server").ThreadedMotoServer
        importlib.import_module("s3fs")
    except ImportError as error:
        skip_or_fail(f"no server for S3 ({error}); install 'moto[server]' and s3fs")
    server = server_of_moto(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3_place(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """URL of an empty place in an object store, which child processes find, too."""
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a-test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of-semviz")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    bucket = f"bucket-{uuid.uuid4().hex}"
    s3fs.S3FileSystem(skip_instance_cache=True).mkdir(bucket)
    return f"s3://{bucket}/city"

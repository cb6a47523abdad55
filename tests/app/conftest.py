"""The page of `annotate` on a test's own ``workspace``, and a hand on it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from annotator_page import Served, annotating
from journeys.driver import LabelDriver

from semviz.workspace.workspace import Workspace

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.fixture
def served(workspace: Workspace) -> Iterator[Served]:
    with annotating(workspace) as served:
        yield served


@pytest.fixture
def driver(served: Served, page: "Page") -> LabelDriver:  # the page goes before its server
    driver = LabelDriver(page)
    driver.open(served.url)
    return driver

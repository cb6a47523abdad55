"""``semviz localize`` tells if stated sigmas are too small, and scales them if asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semviz.runs.reader import load_run
from semviz.workspace import observations
from semviz.workspace.localization.localize import LocalizeOptions, localize_workspace, record
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame
from semviz_core.common.arrays import IntArray

TRUE = 3.0
"""Errors of signs over the stated ones."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace.create_street(tmp_path_factory.mktemp("streets") / "street", 5, range(40))


@pytest.fixture
def noisy_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector whose signs are three times as far off as it states."""
    observe_simulated = observations.observe_simulated

    def noisy(*arguments: object) -> observations.Observe:
        observe = observe_simulated(*arguments)  # type: ignore[arg-type]

        def observe_noisy(frame: Frame) -> tuple[Elements2D, IntArray]:
            seen, ids = observe(frame)
            off = np.random.default_rng(frame.index).normal(0.0, 1.0, (len(seen), 2))
            off *= np.sqrt(TRUE**2 - 1.0) * seen.sigma_px * ~seen.is_line[:, None]
            return replace(seen, anchor_px=seen.anchor_px + off), ids

        return observe_noisy

    monkeypatch.setattr(observations, "observe_simulated", noisy)


@pytest.mark.usefixtures("noisy_signs")
@pytest.mark.parametrize("fits", [False, True])
def test_sigmas_of_signs_that_are_too_small(
    workspace: Workspace,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    fits: bool,
) -> None:
    options = LocalizeOptions(observations="simulated", crop_radius_m=50.0, fit_sigmas=fits)
    localization = localize_workspace(workspace, TRUTH, options)
    record(localization, tmp_path / "run.rrd", workspace="street", map_name=TRUTH, images="none")
    told = capsys.readouterr().err
    assert "The stated sigma of signs is about " in told
    assert ("(sigmas are scaled)" if fits else "(--fit-sigmas scales the sigmas)") in told
    run = load_run(tmp_path / "run.rrd")
    scale = run.info.options.get("sigma_scales", {"pole": 1.0, "sign": 1.0})
    assert scale["pole"] == 1.0
    assert (0.7 * TRUE < scale["sign"] < 1.4 * TRUE) if fits else scale["sign"] == 1.0
    for one in run.frames:
        seen, stated = one.localization.observed, localization.observe(one.frame)[0]
        expected = stated.sigma_px * np.where(seen.is_line, 1.0, scale["sign"])[:, None]
        np.testing.assert_allclose(seen.sigma_px, expected)


def test_true_sigmas_are_not_mentioned(
    workspace: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = LocalizeOptions(observations="simulated", crop_radius_m=50.0)
    localization = localize_workspace(workspace, TRUTH, options)
    record(localization, tmp_path / "run.rrd", workspace="street", map_name=TRUTH, images="none")
    assert "stated sigma" not in capsys.readouterr().err

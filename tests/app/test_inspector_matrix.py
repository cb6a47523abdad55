"""The matrix: what is said of its cells, where they lie, how it is drawn, and its table."""

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest
from inspector_page import near, open_blank, open_flat, pixels, settle, wait_for
from serving import at
from small_runs import saved, small_run, spoiled, unanswered

from semviz.inspector.selection import NOT_MAPPED, NOT_SEEN, element_names, matrix_csv
from semviz.inspector.server import Inspector
from semviz.inspector.views import frame_view
from semviz.runs.run import FrameRecord, Run
from semviz.web.gateway import Gateway
from semviz_core.base.localization import Match
from semviz_core.common.arrays import FloatArray

if TYPE_CHECKING:
    from playwright.sync_api import Page

ROWS = 120
"""So many are seen in the large frame, of 60 to 100 mapped ones."""


def probability(record: FrameRecord) -> FloatArray:
    assert record.localization.match is not None
    return record.localization.match.probability


def large(record: FrameRecord) -> FrameRecord:
    """Everything seen several times, and anything may be anything."""
    result = record.localization
    rng = np.random.default_rng(0)
    times = np.arange(ROWS) % len(result.observed)
    values = rng.dirichlet(np.full(len(result.submap) + 1, 0.05), ROWS + 1)
    match = Match(np.zeros((ROWS, len(result.submap))), values, np.zeros((0, 2), dtype=np.int64))
    many = replace(result, observed=result.observed[times], match=match)
    return FrameRecord(record.frame, many, record.element_id[times])


@pytest.fixture(scope="module")
def run() -> Run:
    """Frames: as it was; a large one; one without an answer."""
    made = small_run()
    second, third = (frame.frame.index for frame in made.frames[1:3])

    def bare(record: FrameRecord) -> FrameRecord:
        failed = unanswered(record)
        return replace(failed, localization=replace(failed.localization, match=None))

    return spoiled(made, {second: large, third: bare})


@pytest.fixture(scope="module")
def path(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(run, tmp_path_factory.mktemp("matrix") / "first.rrd")


# -- as a table


def test_the_table_has_every_digit_and_names_on_both_sides(run: Run) -> None:
    for record in run.frames[:2]:
        head, *rows = csv.reader(io.StringIO(matrix_csv(run, record)))
        names = element_names(record.localization, run.semantic_map.classes)
        assert head == ["seen", *names, NOT_MAPPED]
        seen = [f"#{row}" for row in range(len(record.localization.observed))]
        assert [row[0] for row in rows] == [*seen, NOT_SEEN]
        values = np.array([[float(cell) for cell in row[1:]] for row in rows])
        assert (values == probability(record)).all()
    assert matrix_csv(run, run.frames[2]) == ""


def test_the_table_comes_by_http_under_a_name_of_its_own(run: Run, path: Path) -> None:
    with Gateway(Inspector([path])).running() as url:
        with urlopen(at(url, "matrix.csv?run=first&position=0")) as answer:
            assert answer.read().decode() == matrix_csv(run, run.frames[0])
            index = run.frames[0].frame.index
            assert f"first-{index}-matrix.csv" in answer.headers["Content-Disposition"]
        for query in (
            "run=first&position=2",
            "run=first&position=99",
            "run=first&position=-1",
            "run=none&position=0",
            f"run=first&position={'9' * 5000}",
            "",
        ):
            with pytest.raises(HTTPError, match="404"):
                urlopen(at(url, f"matrix.csv?{query}"))


# -- what is said and where it lies: the page's own modules, on what the page gets


MODEL = """async ([frame, sizes]) => {
  const { MatrixModel } = await import("./page/matrix/matrix_model.js");
  const { MatrixLayout, MIN_CELL } = await import("./page/matrix/matrix_layout.js");
  const model = new MatrixModel(frame, frame.matrix);
  const lost = [];
  const check = (layout, i, j) => {
    const [x, y] = [layout.x(j) + layout.columns.size / 2, layout.y(i) + layout.rows.size / 2];
    if (x < layout.left || x >= layout.end.x || y < layout.top || y >= layout.end.y) return;
    const found = layout.find([x, y]);
    if (found?.observed !== i || found.mapped !== j) lost.push([i, j, found]);
  };
  for (const [width, height] of sizes) {
    const layout = new MatrixLayout(model, width, height);
    const { rows, columns, needs } = layout;
    if (Math.min(rows.size, columns.size) < MIN_CELL) lost.push(["small", width, height]);
    if (width >= needs.width && layout.entropy.x + 22 > width) lost.push(["outside", width]);
    for (const share of [0, 0.5, 1]) {
      layout.scrollTo(share * (columns.length - columns.shown), share * (rows.length - rows.shown));
      for (const i of rows.visible(layout.scroll.y)) {
        for (const j of columns.visible(layout.scroll.x)) check(layout, i, j);
      }
    }
  }
  const { m, n, row, column } = model;
  const each = (count, make) => Array.from({ length: count }, (_, index) => make(index));
  return {
    lost, row, column,
    rank: each(m, (i) => each(n + 1, (j) => model.rank(i, j === n ? null : j))),
    marks: model.rows.map((i) => [i, model.marks.get(i)]),
    said: each(m, (i) => each(n, (j) => model.describe({ of: "cell", observed: i, mapped: j }))),
    entropy: model.describe({ of: "row", observed: 0, measure: "entropy" }),
    names: model.describe({ of: "column", mapped: null }),
  };
}"""
SIZES = [[336, 200], [400, 430], [640, 1500], [120, 90]]


@pytest.fixture(scope="module")
def computed(run: Run, path: Path, chromium: Any) -> list[dict[str, Any]]:
    """What the page's modules make of the first two frames."""
    page = chromium.new_page()
    with Gateway(Inspector([path])).running() as url:
        open_blank(page, url)
        made = [
            page.evaluate(MODEL, [frame_view(run, at).model_dump(mode="json"), SIZES])
            for at in range(2)
        ]
        page.close()
    return cast("list[dict[str, Any]]", made)


@pytest.mark.browser
def test_every_cell_is_found_where_it_is_drawn(computed: list[dict[str, Any]]) -> None:
    assert [matrix["lost"] for matrix in computed] == [[], []]


@pytest.mark.browser
def test_sums_entropies_and_ranks_are_those_of_the_matrix(
    run: Run, computed: list[dict[str, Any]]
) -> None:
    for record, made in zip(run.frames, computed, strict=False):
        values = np.round(probability(record), 4)  # as the page gets them
        for axis, name in ((1, "row"), (0, "column")):
            sums = values.sum(axis=axis)
            assert [bin["sum"] for bin in made[name]] == pytest.approx(sums.tolist())
            shares = values / sums.reshape((-1, 1) if axis else (1, -1))
            logs = np.log2(shares, where=shares > 0, out=np.zeros_like(shares))
            bits = -(shares * logs).sum(axis=axis)
            assert [bin["entropy"] for bin in made[name]] == pytest.approx(bits.tolist(), abs=1e-9)
        larger = (values[:-1, None, :] > values[:-1, :, None]).sum(axis=2)
        assert made["rank"] == (1 + larger).tolist()


@pytest.mark.browser
def test_marks_are_the_likeliest_the_true_and_the_answers(
    run: Run, computed: list[dict[str, Any]]
) -> None:
    record = run.frames[0]
    fine = record.localization.refinement
    assert fine is not None
    fits = {
        (int(i), int(j)): bool(fit) for (i, j), fit in zip(fine.pairs, fine.inlier, strict=True)
    }
    values = np.round(probability(record), 4)
    for i, marks in computed[0]["marks"]:
        places = {mark["mapped"]: mark["place"] for mark in marks if mark["place"]}
        order = np.argsort(-values[i, :-1], kind="stable")[:3]
        assert places == {int(j): k + 1 for k, j in enumerate(order) if values[i, j] >= 0.005}
        true = [mark["mapped"] for mark in marks if mark["isTrue"]]
        assert (
            true == np.flatnonzero(record.localization.submap.id == record.element_id[i]).tolist()
        )
        told = {(i, mark["mapped"]): mark["fit"] for mark in marks if "fit" in mark}
        assert {pair: fit for pair, fit in told.items() if fit is not None} == {
            pair: fit for pair, fit in fits.items() if pair[0] == i
        }


@pytest.mark.browser
def test_the_line_names_cell_probability_rank_truth_and_fit(
    run: Run, computed: list[dict[str, Any]]
) -> None:
    record = run.frames[0]
    fine = record.localization.refinement
    assert fine is not None
    i, j = (int(pair) for pair in fine.pairs[0])
    name = element_names(record.localization, run.semantic_map.classes)[j]
    said = computed[0]["said"][i][j]
    assert said == f"#{i} × {name}: p {probability(record)[i, j]:.3f}, 1st of its row, true, inlier"
    assert all("true" not in text for k, text in enumerate(computed[0]["said"][i]) if k != j)
    assert " equally likely candidates" in computed[0]["entropy"]
    assert computed[0]["names"].startswith("not in the map: ")


# -- on the page


@pytest.mark.browser
def test_a_large_matrix_scrolls_to_what_is_selected(run: Run, path: Path, page: "Page") -> None:
    with Gateway(Inspector([path])).running() as url:
        page.set_viewport_size({"width": 1280, "height": 720})
        open_flat(page, url, f"frame={run.frames[1].frame.index}")
        scroller = page.locator("#matrix-scroller")
        assert scroller.evaluate("e => [e.scrollTop, e.scrollHeight > e.clientHeight]") == [0, True]
        page.keyboard.press("Shift+Tab")  # to the one with the largest number
        wait_for(page, lambda: scroller.evaluate("e => e.scrollTop > 0"), "its row in sight")
        box = scroller.bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 100, box["y"] + 60)
        value = page.locator("#matrix-value")
        wait_for(page, lambda: " × " in (value.text_content() or ""), "the cell's name")
        assert page.locator("#matrix-canvas").bounding_box() == pytest.approx(box, abs=1)
        page.close()


@pytest.mark.browser
def test_sums_that_are_not_one_are_marked_and_nothing_is_drawn_without_a_matrix(
    run: Run, path: Path, page: "Page"
) -> None:
    with Gateway(Inspector([path])).running() as url:
        page.emulate_media(color_scheme="dark")
        open_flat(page, url)
        assert near(pixels(page, "#matrix"), "#F0532D") == 0
        page.keyboard.press(".")
        wait_for(page, lambda: near(pixels(page, "#matrix"), "#F0532D") > 100, "wrong sums")
        linear = pixels(page, "#matrix-canvas")
        page.keyboard.press("m")
        wait_for(page, lambda: page.inner_text("#matrix-least") == "0.001", "logarithmic colour")
        settle(page)
        assert (np.abs(pixels(page, "#matrix-canvas") - linear).max(axis=2) > 10).mean() > 0.02
        page.keyboard.press(".")
        wait_for(page, lambda: page.locator("#matrix-none").is_visible(), "no probabilities")
        assert not page.locator("#matrix-csv").is_visible()
        page.close()

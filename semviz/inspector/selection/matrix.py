"""The matrix of a frame: candidates of one row or column, and all of it as a table."""

import csv
import io
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from aiohttp import web

from semviz.inspector.shelf import Shelf
from semviz.recording.run import FrameRecord, Run
from semviz_core.arrays import FloatArray
from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError
from semviz_core.localization import Localization

NOT_MAPPED = "not in the map"
NOT_SEEN = "not seen"
"""Headings of the dustbins."""
LISTED = 4
LEAST = 0.0005
"""Candidates below are 0.000 and not listed."""
Json = dict[str, Any]


def candidates_of_row(run: Run, record: FrameRecord, row: int) -> list[Json]:
    """The likeliest map elements of a detection, the dustbin and the true one."""
    one = record.localization
    if one.match is None:
        return []
    names = [*element_names(one, run.semantic_map.classes), NOT_MAPPED]
    ids = [*one.submap.id.tolist(), None]
    true = np.flatnonzero(one.submap.id == record.element_id[row]).tolist()
    cells = {j: {"name": names[j], "observed": row, "element": ids[j]} for j in range(len(names))}
    return _listed(one.match.probability[row], cells, true)


def candidates_of_column(record: FrameRecord, element_id: int) -> list[Json]:
    """The likeliest detections of a map element, the dustbin and the true one; none where it is
    not in the submap."""
    one = record.localization
    columns = np.flatnonzero(one.submap.id == element_id)
    if one.match is None or not len(columns):
        return []
    rows = len(one.observed)
    names = [*(f"#{i}" for i in range(rows)), NOT_SEEN]
    cells = {
        i: {"name": names[i], "observed": i if i < rows else None, "element": element_id}
        for i in range(rows + 1)
    }
    true = np.flatnonzero(record.element_id == element_id).tolist()
    return _listed(one.match.probability[:, columns[0]], cells, true)


def _listed(probability: FloatArray, cells: dict[int, Json], true: list[int]) -> list[Json]:
    """The ``LISTED`` likeliest cells of a row or column (n + 1), and the true ones behind them."""
    order = np.argsort(-probability, kind="stable").tolist()
    rank = {cell: place + 1 for place, cell in enumerate(order)}
    likely = [cell for cell in order[:LISTED] if probability[cell] >= LEAST]
    listed = likely + [cell for cell in true if cell not in likely]
    return [
        cells[cell]
        | {"probability": float(probability[cell]), "rank": rank[cell], "isTrue": cell in true}
        for cell in listed
    ]


def matrix_csv(run: Run, record: FrameRecord) -> str:
    """Probabilities as recorded, to the last digit; empty where the frame has none.

    Columns are mapped elements by name, rows are detections by number; the dustbins come last.
    """
    one = record.localization
    if one.match is None:
        return ""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["seen", *element_names(one, run.semantic_map.classes), NOT_MAPPED])
    seen = [*(f"#{row}" for row in range(len(one.observed))), NOT_SEEN]
    for name, row in zip(seen, one.match.probability.tolist(), strict=True):
        table.writerow([name, *row])  # csv writes floats as repr does: exactly
    return text.getvalue()


def element_names(one: Localization, classes: ClassSet) -> list[str]:
    """(n) names of the submap's elements, such as ``P-04``."""
    pairs = zip(one.submap.class_id.tolist(), one.submap.id.tolist(), strict=True)
    return [classes.element_name(class_id, id) for class_id, id in pairs]


def matrix_route(shelf: Shelf) -> web.AbstractRouteDef:
    """``/matrix.csv?run=NAME&position=K``: the matrix of a frame."""

    async def answer(request: web.Request) -> web.Response:
        name, position = request.query.get("run", ""), request.query.get("position", "")
        try:
            run = shelf.run(name)
            record = run.frames[range(len(run.frames)).index(int(position))]
        except (SemvizError, ValueError):
            raise web.HTTPNotFound(text="no such frame\n") from None
        table = matrix_csv(run, record)
        if not table:
            raise web.HTTPNotFound(text="this frame has no probabilities\n")
        file = f"{Path(name).name}-{record.frame.index}-matrix.csv"
        said = {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(file)}"}
        return web.Response(text=table, content_type="text/csv", headers=said)

    return web.get("/matrix.csv", answer)

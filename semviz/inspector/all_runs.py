"""The page with all runs as one table, such as the drives of a batch: ``/runs``.

It shows what ``semviz evaluate`` says of each run, from the table at the end of its file, so that
hundreds of runs are read in seconds.
"""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
from aiohttp import web

from semviz.inspector.context import RunLibrary
from semviz.runs.arrow_table import FrameRows, arrow_table
from semviz.runs.stored_run import stored_table
from semviz_core.common.errors import SemvizError

PAGE = Path(__file__).parent / "page" / "runs" / "runs.html"


def all_runs_routes(library: RunLibrary) -> list[web.AbstractRouteDef]:
    """Serve the page at ``/runs``, and its rows as JSON at ``/runs.json``."""

    async def page(_: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE)

    async def rows(_: web.Request) -> web.Response:
        found = await asyncio.to_thread(run_rows, library)
        return web.json_response(found, headers={"Cache-Control": "no-store"})

    return [web.get("/runs", page), web.get("/runs.json", rows)]


def run_rows(library: RunLibrary) -> dict[str, Any]:
    """Return a row for each run and one for all frames. A run without a usable table has its name
    alone: it is read through when it is opened."""
    found = {name: table for name in library.names for table in _tables(library.path(name), name)}
    runs = [
        _row(name, FrameRows(found[name])) if name in found else {"run": name}
        for name in library.names
    ]
    if not found:
        return {"runs": runs, "all": None}
    whole = pa.concat_tables(found.values()).unify_dictionaries()
    return {"runs": runs, "all": _row("", FrameRows(whole))}


def _tables(path: Path, name: str) -> Iterator[Any]:
    """Yield the frames of a run as an Arrow table, if it ends with a usable one."""
    try:
        stored = stored_table(path)
    except (SemvizError, OSError):
        return
    if stored is not None:
        yield arrow_table(stored.frames, name)


def _row(name: str, rows: FrameRows) -> dict[str, Any]:
    summary = rows.figures.summary()
    faults = {kind: count for kind, count in rows.diagnoses.items() if kind != "healthy"}
    return {
        "run": name,
        "frames": len(rows),
        **{status: one.frames for status, one in summary.by_status.items()},
        "rte_m": summary.accuracy.rte_m.q2,
        "rre_deg": summary.accuracy.rre_deg.q2,
        "share_below_1m": summary.accuracy.share_below_1m,
        "overconfident": rows.overconfident,
        "fault": next(iter(faults), ""),
        "faults": ", ".join(f"{kind} {count}" for kind, count in faults.items()),
    }

"""Write docs/examples/look.ipynb with its pictures: python docs/make_notebook.py.

The cells run in this process; no notebook server is needed.
"""

import json
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from semviz.cli import main

CELLS = (
    "# Look at a run\n\nMaps, runs and localizations show themselves in a notebook. Everything "
    "here is simulated.",
    "from semviz import load_run\n\nrun = load_run(\"search.rrd\")  # of 'semviz localize'\nrun",
    "run.semantic_map",
    "frame = run.frames[5]\nframe.localization",
    "failed = [frame for frame in run.frames if frame.localization.status != 'ok']\n"
    "failed[0].localization if failed else 'no frame failed'",
)


def outputs_of(code: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Run a cell; its last line is what it shows."""
    *before, last = code.splitlines()
    exec("\n".join(before), names)
    value = eval(last, names)
    data = {"text/plain": repr(value) if isinstance(value, str) else type(value).__name__}
    if hasattr(value, "_repr_html_"):
        data["text/html"] = value._repr_html_()
    return [{"output_type": "execute_result", "execution_count": 1, "metadata": {}, "data": data}]


def make_notebook() -> dict[str, Any]:
    """Return the notebook as JSON values."""
    names: dict[str, Any] = {}
    cells = []
    for number, text in enumerate(CELLS):
        cell: dict[str, Any] = {"id": f"cell-{number}", "metadata": {}, "source": text}
        if number == 0:
            cells.append(cell | {"cell_type": "markdown"})
        else:
            shown = {"execution_count": 1, "outputs": outputs_of(text, names)}
            cells.append(cell | {"cell_type": "code"} | shown)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": about, "nbformat": 4, "nbformat_minor": 5}


def semviz(*words: object) -> None:
    try:
        main([str(word) for word in words])
    except SystemExit as ended:
        if ended.code:
            raise


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        street, run = Path(folder) / "street", Path(folder) / "search.rrd"
        semviz("new", street, "--simulate", 7, "--frames", "0:24")
        semviz("localize", street, "--map", "truth", "--images", "none", "--out", run)
        os.chdir(folder)
        notebook = make_notebook()
    target = Path(__file__).resolve().parent / "examples" / "look.ipynb"
    target.write_text(json.dumps(notebook, indent=1) + "\n")
    print(target)

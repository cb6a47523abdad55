"""G5: every command on a small sequence, and on bad input: exit status, JSON and files."""

import csv
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

from golden import workspaces
from golden.canonical import digest, numbered_ids, sha
from golden.command import run
from golden.files import FIXTURES, masked, run_content, table_content, unpacked

DRIVE = """
new lot --simulate 5 --frames 0:4
new mono2 --kitti kitti --sequence 07 --cameras 2 --frames 0:12:2
labels import town town.jsonl --json
labels import lane lane.jsonl
labels check town --json
labels check lane
labels propose town proposals.json --json
labels export town coco.json --json
labels export town out.jsonl --json
labels export town out.xml --side left
labels backup town backup.db
labels restore lane backup.db
labels import lot coco.json --json --author ben
map build town --json
map build town --name paper --method paper --json
map build town --name refined --refine-poses
map check town --json
map check town --map refined --gate --max-rmse-px 0.1 --json
map diff town main refined --json
map diff town main paper
map localizability town --frames 0:2 --json
map localizability town --frames 4:5 --plot route.png
map export town map.geojson --anchor=49.01,8.42,115 --json
map import town map.geojson --name back --json
localize town --frames 0:24:2 --images none
localize town --frames 0:24:2 --images none --method learned --heading-sigma-deg 5 --out learned.rrd
localize town --frames 0:24:2 --images none --method paper --out paper.rrd
localize town --frames 0:24 --images none --track
labels import mono mono.jsonl
map build mono --json
localize mono --images reference --out mono.rrd
localize lot --map truth --images none --noise paper --seed 3 --out lot.rrd
localize lot --map truth --images both --observations simulated --frames 0:2 --out both.rrd
evaluate town/runs/search.rrd learned.rrd --json --csv rows.csv
evaluate lot.rrd --json
evaluate lot.rrd
compare town/runs/search.rrd learned.rrd --json
compare town/runs/search.rrd paper.rrd --fail-if 'median_rte_m > 1.05*base' --json
compare town/runs/search.rrd paper.rrd
report town/runs/search.rrd paper.rrd --out report.md
report town/runs/search.rrd --out report.tex
report lot.rrd --out report.html --pictures 1
repair cut.rrd --out whole.rrd
trajectory town/runs/search.rrd tum.txt --json
trajectory town kitti.txt --format kitti --json
benchmark --methods search,direct --noise low --frames 6 --no-plots --out bench --json
benchmark --methods minimal --suite matched --noise low --frames 4 --no-plots --out bench2
train paper --out training --samples 8 --batch 4 --held-out 4 --workers 0
weights training --out weights
localize town --frames 0:4:2 --method paper --weights weights/paper.safetensors --out mine.rrd
detect lot --frames 0:1 --sides left
detect evaluate --streets 1 --frames-a-street 1 --json
"""
BAD = """
new town --simulate 7
new other
new other --simulate -1
new other --simulate 1 --frames 5:2
new other --kitti nowhere
serve nowhere
serve town/semviz.toml
serve lot.rrd --port 70000
annotate nowhere
annotate town --port 70000
labels import town nowhere.xml
labels import town broken.xml
labels export town out.xml --format log --side left
labels export nowhere out.xml
labels propose town broken.json
labels check mono2
labels check nowhere
labels backup mono2 out.db
labels restore town broken.json
map build town --frames 5
map build town --method paper --refine-poses
map build town --name a/b
map check town --map gone
map diff town main gone
map localizability town --plot route.txt
map export town map.xyz
map export town map.osm
map import town broken.xml
map import town map.geojson --name main
localize town --map gone
localize lot --map truth --images reference
localize town --method gone
localize town --prior-distance 9:1
localize town --weights proposals.json
localize town --observations detected
evaluate
evaluate nowhere.rrd
evaluate broken.json
compare lot.rrd town/runs/search.rrd
compare town/runs/search.rrd learned.rrd --fail-if 'speed > 1'
report lot.rrd --out report.doc
report lot.rrd --pictures -1
open nowhere.rrd
open broken.json
repair broken.json
trajectory nowhere.rrd out.txt
trajectory town out.txt --truth
benchmark --methods gone
benchmark --suite gone
benchmark --frames 0
train gone --out training2
train paper --out training2 --batch 0
train paper --out training2 --kitti-poses poses
weights town --out weights2
detect nowhere
detect town --model nowhere.toml
detect train --streets 0 --out training3
detect train --out training3 --workers 0
detect evaluate --reach-m 0
detect evaluate --frames 0:2
nonsense
localize
map
labels
"""
MASKED_KEYS = re.compile(
    r"(^|_)ms(_|$)|^(seconds|wall_s|machines|created|version|semviz|code|made_by|hash)$"
)
"""JSON keys with times, durations, machines, versions, and hashes of source files (``code``) or of
logs with times."""
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
PROPOSALS = """{"format": "semviz-proposals", "version": 1, "proposals": [
{"frame_index": 0, "side": "left", "class": "pole", "anchor_px": [412.3, 58.1],
 "end_px": [413.0, 201.7], "end_known": false, "score": 0.94, "sigma_px": 1.2},
{"frame_index": 1, "side": "left", "class": "triangular sign", "anchor_px": [770.0, 120.5],
 "score": 0.55}]}"""


def golden_values(folder: Path) -> dict[str, Any]:
    """Run the commands in order, in one folder. Return exit status, JSON and files of each."""
    _prepare(folder)
    found: dict[str, Any] = {}
    for number, line in enumerate([*DRIVE.split("\n")[1:-1], *BAD.split("\n")[1:-1]], 1):
        before = _files(folder)
        ended = run(folder, *shlex.split(line))
        name = f"{number:03} {line}"
        data, words = _parsed(ended.output)
        changed = [path for path, state in _files(folder).items() if before.get(path) != state]
        files = {path: content(folder / path) for path in sorted(changed)}
        found[name] = {"status": ended.status, "json": data, "files": files}
        found[f"words: {name}"] = sha(_wording(words + ended.errors))
    return found


def _prepare(folder: Path) -> None:
    for name in workspaces.NAMES:
        workspaces.make(folder, name, labelled=False)
        unpacked(FIXTURES / f"{name}.jsonl.gz", folder)
    (folder / "proposals.json").write_text(PROPOSALS)
    (folder / "broken.json").write_text("{")
    (folder / "broken.xml").write_text("<annotations><image")
    whole = unpacked(FIXTURES / "run-version-3.rrd.gz", folder).read_bytes()
    (folder / "cut.rrd").write_bytes(whole[: len(whole) * 9 // 10])


def _files(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of each file that a command may have written."""
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in (".db-wal", ".db-shm")
    }


def _parsed(output: str) -> tuple[Any, str]:
    """Return hashes of printed JSON values by key, and all sentences in the output."""
    try:
        value = json.loads(output)
    except ValueError:
        return None, output
    data, words = parted(value)
    hashes = {key: digest(value) for key, value in data.items()} if isinstance(data, dict) else data
    return hashes, "\n".join(words)


def parted(value: Any) -> tuple[Any, list[str]]:
    """Return JSON without MASKED_KEYS and sentences, and the sentences: texts with spaces."""
    if isinstance(value, str):
        return ("", [value]) if " " in value else (numbered_ids(value), [])
    if isinstance(value, list):
        pairs = [parted(item) for item in value]
        return [pair for pair, _ in pairs], [text for _, texts in pairs for text in texts]
    if not isinstance(value, dict):
        return value, []
    kept: dict[str, Any] = {}
    words: list[str] = []
    for key, item in value.items():
        if MASKED_KEYS.search(key):
            continue
        kept[key if " " not in key else f"sentence {len(kept)}"], texts = parted(item)
        words += ([key] if " " in key else []) + texts
    return kept, words


def content(path: Path) -> Any:
    """Return the content of a file; for formats whose bytes a library decides, that it exists."""
    match path.suffix:
        case ".rrd":
            return digest(run_content(path))
        case ".parquet":
            return digest(table_content(path))
        case ".json":
            return _json_content(path.read_text())
        case ".jsonl":
            return sha("".join(_json_content(line) for line in path.read_text().splitlines()))
        case ".csv":
            return _csv_content(path.read_text())
        case ".txt" | ".xml" | ".geojson" | ".toml":
            return sha(masked(path.read_text()))
    return "there"


def _json_content(text: str) -> str:
    try:
        return digest(parted(json.loads(masked(text)))[0])
    except ValueError:
        return "no JSON"


def _csv_content(text: str) -> str:
    """Return the hash of a table without its columns of times."""
    rows = csv.DictReader(io.StringIO(text))
    kept = [
        {key: value for key, value in row.items() if not MASKED_KEYS.search(key)} for row in rows
    ]
    return digest(kept)


def _wording(text: str) -> str:
    """Return text without its numbers, which may be times, and without the widths of tables."""
    return " ".join(_NUMBER.sub("#", masked(text)).split())

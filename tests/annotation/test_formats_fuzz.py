"""Whatever a file holds, only a SemvizError comes out of a reader. ``bench/fuzz.py`` does more."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from label_files import FRAMES, RULES, said, store_of, street
from mutations import mutated

from semviz_annotation.label_formats.coco import read_coco
from semviz_annotation.label_formats.cvat import read_cvat
from semviz_annotation.label_formats.exchange import ExportFormat, export_labels
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.labelme import read_labelme
from semviz_annotation.label_formats.reading import ParsedLabels
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposals import Proposals, read_proposals, save_proposals
from semviz_core.common.errors import SemvizError

PROPOSALS = b"""{"format": "semviz-proposals", "version": 1, "proposals": [
 {"frame_index": 1, "side": "left", "class": "pole", "anchor_px": [1, 2], "end_px": [1.5, 90],
  "score": 0.5, "sigma_px": 1.5, "anchor_known": false},
 {"frame_index": 2, "side": "right", "class": "rounded sign", "anchor_px": [9, 9], "score": 1}]}"""


@pytest.mark.parametrize(
    ("format_", "read"),
    [
        ("cvat", read_cvat),
        ("cvat-video", read_cvat),
        ("labelme", read_labelme),
        ("coco", read_coco),
    ],
)
def test_readers(
    tmp_path: Path, format_: ExportFormat, read: Callable[[Path, LabelImportContext], ParsedLabels]
) -> None:
    with store_of(street(), tmp_path / "store") as store:
        export_labels(store, tmp_path / "out", format_)
    out = tmp_path / "out"
    data = (out if out.is_file() else out / "left" / "000003.json").read_bytes()
    path, rng = tmp_path / "input", random.Random(1)
    read_whole, refused = 0, list[str]()
    for _ in range(300):
        path.write_bytes(mutated(data, rng))
        try:
            found = read(path, LabelImportContext(RULES, FRAMES, "left"))
            plan = plan_import(found.observations, Labels())
            edit = ImportLabels(tuple(plan.elements), tuple(plan.observations))
            labels = Labels().changed(edit.changes(Labels(), RULES))
            assert len(said(labels)) == len(plan.observations)
            read_whole += 1
        except SemvizError as error:
            refused.append(str(error))
    assert min(read_whole, len(refused)) > 20  # both ways were tried
    assert all(one_line(message) for message in refused)


def test_proposals(tmp_path: Path) -> None:
    path, rng = tmp_path / "input", random.Random(1)
    path.write_bytes(PROPOSALS)
    save_proposals(read_proposals(path), tmp_path / "parquet")
    for data in (PROPOSALS, (tmp_path / "parquet").read_bytes()):
        refused = []
        for _ in range(200):
            path.write_bytes(mutated(data, rng))
            try:
                assert isinstance(read_proposals(path, rig=RULES.rig, frames=FRAMES), Proposals)
            except SemvizError as error:
                refused.append(str(error))
        assert all(one_line(message) for message in refused)


def one_line(message: str) -> bool:
    return "\n" not in message and bool(message.encode())

"""Proposals of a detector: one contract, two file formats, kept in the workspace."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from label_files import RIG

from semviz import cli
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_elements, as_proposals
from semviz_annotation.labels.proposal import ProcessedImages, Proposal
from semviz_annotation.labels.proposals import (
    Proposals,
    load_proposals,
    read_proposals,
    save_proposals,
)
from semviz_annotation.labels.rows import derived_id, is_id
from semviz_core.base.camera import Rig
from semviz_core.base.elements import Elements2D
from semviz_core.common.errors import SemvizError

POLE: dict[str, Any] = {
    "frame_index": 3, "side": "left", "class": "pole", "anchor_px": [10.5, 20.0],
    "end_px": [11, 200.25], "score": 0.9,
}  # fmt: skip
SIGN: dict[str, Any] = {
    "frame_index": 3, "side": "right", "class": "rounded sign", "anchor_px": [7.0, 8.0],
    "score": 1, "sigma_px": 1.5, "id": derived_id("sign"),
}  # fmt: skip


def write(folder: Path, *rows: Any, **more: Any) -> Path:
    path = folder / "found.json"
    document = {"format": "semviz-proposals", "version": 1, "proposals": list(rows), **more}
    path.write_text(json.dumps(document))
    return path


def write_parquet(folder: Path, *rows: dict[str, Any]) -> Path:
    flat = []
    for row in rows:
        parts = {key: value for key, value in row.items() if not key.endswith("_px")}
        parts |= {"sigma_px": row["sigma_px"]} if "sigma_px" in row else {}
        for name in ("anchor", "end"):
            u, v = row.get(f"{name}_px", (None, None))
            parts |= {
                f"{name}_u": None if u is None else float(u),
                f"{name}_v": None if v is None else float(v),
            }
        flat.append(parts | {"score": float(row["score"])})
    pq.write_table(pa.Table.from_pylist(flat), folder / "found.parquet")
    return folder / "found.parquet"


def rows_of(proposals: Proposals) -> list[Proposal]:
    return [proposals[row] for row in range(len(proposals))]


def test_what_is_read(tmp_path: Path) -> None:
    first, second = rows_of(read_proposals(write(tmp_path, POLE, SIGN), rig=RIG, frames=range(9)))
    assert is_id(first.id)
    assert first == Proposal(
        id=first.id, frame_index=3, side="left", class_id=0, anchor_px=(10.5, 20.0),
        end_px=(11.0, 200.25), anchor_known=True, end_known=True, score=0.9, sigma_px=2.0,
    )  # fmt: skip
    assert (second.id, second.sigma_px) == (SIGN["id"], 1.5)
    assert (second.end_px, second.end_known) == (None, False)


def test_parquet_says_the_same(tmp_path: Path) -> None:
    columns = POLE | {"end_known": False, "id": None, "sigma_px": 3.0}, SIGN | {"end_known": None}
    plain = {key: value for key, value in columns[0].items() if value is not None}
    from_parquet = read_proposals(write_parquet(tmp_path, *columns), rig=RIG)
    assert rows_of(from_parquet) == rows_of(read_proposals(write(tmp_path, plain, SIGN)))


def test_an_id_follows_from_what_is_said_and_not_from_the_score(tmp_path: Path) -> None:
    ids = [
        read_proposals(write(tmp_path, POLE | change)).id[0]
        for change in ({}, {"score": 0.1}, {"side": "right"}, {"end_px": [11, 200.5]})
    ]
    assert ids[0] == ids[1]
    assert len(set(ids)) == 3


@st.composite
def any_proposals(draw: st.DrawFn) -> Proposals:
    pixel = st.tuples(st.floats(-0.5, 639.5), st.floats(-0.5, 200.0))
    rows = []
    for number in range(draw(st.integers(0, 6))):
        class_id = draw(st.integers(0, 3))
        anchor_px = draw(pixel)
        end_px = (anchor_px[0], anchor_px[1] + 99.0) if class_id == 0 else None
        rows.append(
            Proposal(
                id=derived_id(f"{number}"), frame_index=draw(st.integers(0, 2)),
                side=draw(st.sampled_from(["left", "right"])), class_id=class_id,
                anchor_px=anchor_px, end_px=end_px, anchor_known=draw(st.booleans()),
                end_known=end_px is not None and draw(st.booleans()),
                score=draw(st.floats(0, 1)), sigma_px=draw(st.floats(0.125, 100)),
            )
        )  # fmt: skip
    return Proposals.of(rows)


@settings(max_examples=40)
@given(proposals=any_proposals())
def test_what_is_kept_is_the_same(
    proposals: Proposals, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("kept") / "proposals.parquet"
    save_proposals(proposals, path)
    kept = load_proposals(path)
    assert rows_of(kept) == rows_of(proposals)
    for frame in range(3):
        of_frame = [row for row in rows_of(proposals) if row.frame_index == frame]
        assert sorted(kept.in_frame(frame), key=id_of) == sorted(of_frame, key=id_of)
        scores = [row.score for row in kept.in_frame(frame)]
        assert scores == sorted(scores, reverse=True)
        left = {row.id for row in kept.in_frame(frame, "left")}
        assert left == {row.id for row in of_frame if row.side == "left"}
    assert kept.frames == tuple(sorted({row.frame_index for row in rows_of(proposals)}))


def id_of(row: Proposal) -> str:
    return row.id


def test_newer_ones_take_the_place_of_those_with_their_id(tmp_path: Path) -> None:
    old = read_proposals(write(tmp_path, POLE, SIGN))
    new = read_proposals(write(tmp_path, SIGN | {"score": 0.25}, POLE | {"frame_index": 4}))
    joined = old.joined(new)
    assert [row.score for row in rows_of(joined)] == [0.9, 0.25, 0.9]
    assert len(Proposals().joined(old)) == 2
    assert Proposals().in_frame(3) == ()
    assert not len(load_proposals(tmp_path / "none"))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ((POLE, POLE | {"score": 1.5}), "item 2: score: .*less than or equal to 1"),
        ((POLE | {"anchor_px": [1, float("nan")]},), "item 1: anchor_px.1: .*finite"),
        ((POLE | {"anchor_px": [1]},), "item 1: anchor_px.1: Field required"),
        ((POLE | {"frame_index": 3.5},), "item 1: frame_index"),
        ((POLE | {"frame_index": -1},), "item 1: frame_index"),
        ((POLE | {"frame_index": 12},), "item 1: there is no frame 12"),
        ((POLE | {"side": "middle"},), "item 1: side: .*'left' or 'right'"),
        ((POLE | {"class": "tree"},), "item 1: unknown class 'tree'; known are pole, triang"),
        ((POLE | {"end_px": None},), "item 1: a pole needs anchor_px and end_px"),
        ((SIGN | {"end_px": [1, 2]},), "item 1: a rounded sign has no end_px"),
        ((POLE | {"end_px": [10.5, 20.1]},), "item 1: peak and bottom are the same point"),
        ((SIGN, POLE | {"end_px": [700, 1]}), r"item 2: point \(700.0, 1.0\) is outside the left"),
        ((POLE, SIGN | {"anchor_px": [-0.6, 1]}), "item 2: point .* is outside the right image"),
        ((POLE | {"sigma_px": 0},), "item 1: sigma_px"),
        ((POLE | {"id": "7"},), "item 1: id"),
        ((POLE, SIGN, POLE), "item 3: duplicates item 1, or has its id"),
        ((SIGN, SIGN | {"score": 0.5}), "item 2: duplicates item 1"),
        ((POLE | {"colour": "red"},), "item 1: colour: Extra inputs"),
        (({**POLE, "score": "0.5"},), "item 1: score"),
        ((3,), "item 1: .*object"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, rows: tuple[Any, ...], words: str) -> None:
    with pytest.raises(SemvizError, match=words) as caught:
        read_proposals(write(tmp_path, *rows), rig=RIG, frames=range(9))
    line = str(caught.value)
    assert line.startswith(str(tmp_path / "found.json, item"))
    assert line.endswith(". Nothing was imported.")
    assert "\n" not in line


def test_a_flipped_bit_never_gives_other_proposals(tmp_path: Path) -> None:
    """Without checksums of the pages, about one of twenty moved a mark or changed a score."""
    path, rng = tmp_path / "proposals.parquet", np.random.default_rng(5)
    rows = (POLE, SIGN, POLE | {"frame_index": 4, "anchor_px": [310.25, 21.0], "score": 0.7})
    save_proposals(read_proposals(write(tmp_path, *rows), rig=RIG, frames=range(9)), path)
    whole, kept = path.read_bytes(), rows_of(load_proposals(path))
    refused = 0
    for _ in range(200):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        try:
            assert rows_of(load_proposals(path)) == kept
        except SemvizError:
            refused += 1
    assert refused > 50


def test_what_is_no_file_of_proposals_is_refused(tmp_path: Path) -> None:
    for more in ({"format": "coco"}, {"version": 2}, {"more": 1}, {"proposals": 3}):
        with pytest.raises(SemvizError, match=r"found.json: not a file of proposals \("):
            read_proposals(write(tmp_path, **more))
    (tmp_path / "a").write_bytes(b"PAR1 and nothing more")
    with pytest.raises(SemvizError, match="a: not a readable Parquet file"):
        read_proposals(tmp_path / "a")
    with pytest.raises(SemvizError, match="none: cannot be read"):
        read_proposals(tmp_path / "none")
    with pytest.raises(SemvizError, match="item 1: this sequence has no right camera"):
        read_proposals(write(tmp_path, SIGN), rig=Rig(RIG.left))


def test_columns_that_are_wrong_are_named(tmp_path: Path) -> None:
    path = write_parquet(tmp_path, POLE, SIGN)
    table = pq.read_table(path)
    sides = table.drop_columns(["side"])
    for changed, words in (
        (sides, "no column 'side'"),
        (table.append_column("colour", pa.array([1, 2])), "unknown column 'colour'"),
        (table.append_column("side", table["side"]), "two columns of one name"),
        (sides.append_column("side", pa.array([["left"]] * 2)), "column 'side' holds lists"),
        (sides.append_column("side", pa.array(["x" * 200] * 2)), "a side of more than 100 char"),
    ):
        pq.write_table(changed, path)
        with pytest.raises(SemvizError, match=words):
            read_proposals(path)
    frames = table.drop_columns(["frame_index"])
    pq.write_table(frames.append_column("frame_index", pa.array([1.5, 2.5])), path)
    with pytest.raises(SemvizError, match="item 1: frame_index"):
        read_proposals(path)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town = tmp_path / "town"
    workspace = Workspace.create_street(town, 7, frames=range(4))

    def propose(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            cli.main(["labels", "propose", str(town), str(tmp_path / "found.json"), *words])
        out = capsys.readouterr()
        return int(caught.value.code or 0), out.out, out.err

    write(tmp_path, POLE, SIGN)
    assert propose() == (0, f"{town}/proposals.parquet: 2 proposals read, 2 in total\n", "")
    before = workspace.proposals_path.read_bytes()
    write(tmp_path, POLE | {"frame_index": 99})
    status, _, err = propose("--replace")
    assert (status, "item 1: there is no frame 99" in err) == (2, True)
    assert workspace.proposals_path.read_bytes() == before
    write(tmp_path, POLE | {"frame_index": 2})
    assert json.loads(propose("--json")[1])["kept"] == 3
    assert propose("--replace")[1].endswith("1 proposals read, 1 in total\n")
    assert load_proposals(workspace.proposals_path).frames == (2,)


def test_arrays_are_of_one_length() -> None:
    proposals = Proposals()
    assert proposals.anchor_px.shape == proposals.end_px.shape == (0, 2)
    assert np.array_equal(proposals.frame_index, np.zeros(0))


def test_finds_go_there_and_back(tmp_path: Path) -> None:
    """What a detector found comes back to the last digit, and which images it looked at."""
    elements = Elements2D(
        anchor_px=np.array([[10.1, 20.0], [30.3, 40.0], [-3.0, 5.0], [50.0, -9.0]]),
        end_px=np.array([[11.7, 90.0], [np.nan, np.nan], [np.nan, np.nan], [50.0, -3.0]]),
        class_id=np.array([0, 2, 1, 0]), score=np.array([0.9, 0.5, 0.4, 0.3]),
        sigma_px=np.array([[0.3, 4.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]),
        anchor_known=np.ones(4, bool), end_known=np.array([False, False, False, True]),
    )  # fmt: skip
    rows = as_proposals(3, "left", elements, RIG.left, "ours")
    assert [row.anchor_px for row in rows] == [(10.1, 20.0), (30.3, 40.0), (0.0, 5.0)]
    looked = ProcessedImages(
        "ours", {"model": "1a", "least": None}, frozenset({(3, "left"), (4, "right")})
    )
    save_proposals(Proposals.of(rows, looked), tmp_path / "kept.parquet")
    kept = load_proposals(tmp_path / "kept.parquet")
    assert kept.processed == looked
    assert kept.rows() == rows
    back = as_elements(kept.in_frame(3), "box")
    for name, values in vars(back).items():
        np.testing.assert_array_equal(values[:2], vars(elements)[name][:2])


def test_whose_finds_count() -> None:
    """Those of 'semviz detect' where it looked; else whatever was brought in."""
    elements = Elements2D.from_ends([[5.0, 6.0]], [[np.nan, np.nan]], [1])
    own = as_proposals(3, "left", elements, RIG.left, "ours")
    other = as_proposals(3, "right", elements, RIG.left, "theirs")
    assert Proposals.of([*own, *other]).detections == (*own, *other)
    assert Proposals.of([*own, *other], ProcessedImages("ours")).detections == own
    assert Proposals.of(own, ProcessedImages("ours")).joined(
        Proposals.of(other)
    ).processed == ProcessedImages("ours")

"""Maps on disk: every bit comes back, and no broken file is taken for a map."""

import json
import random
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from equality import assert_same
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ClassSet, ElementClass
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import FORMAT, VERSION, load_map, save_map
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import LARGEST
from semviz_core.common.errors import SemvizError
from semviz_core.simulation.street import Street

FINITE = st.floats(-LARGEST, LARGEST)
WORDS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
BEACON = ElementClass(9, "beacon", "point", "B", "diamond", "#112233", "#445566")


@st.composite
def maps(draw: st.DrawFn) -> SemanticMap:
    n = draw(st.integers(0, 6))
    end = draw(hnp.arrays(np.float64, (n, 3), elements=FINITE))
    is_line = draw(hnp.arrays(np.bool_, n))
    end[~is_line] = np.nan
    covariance = draw(hnp.arrays(np.float64, (n, 6, 6), elements=FINITE))
    covariance[:, range(6), range(6)] = np.abs(covariance[:, range(6), range(6)])
    ids = draw(st.lists(st.integers(0, 2**63 - 1), min_size=n, max_size=n, unique=True))
    elements = Elements3D(
        id=np.array(ids, dtype=np.int64),
        anchor_m=draw(hnp.arrays(np.float64, (n, 3), elements=FINITE)),
        end_m=end,
        class_id=np.where(
            is_line, POLE, draw(hnp.arrays(np.int64, n, elements=st.sampled_from([1, 2, 3, 9])))
        ),
        covariance_m2=covariance,
        anchor_known=draw(hnp.arrays(np.bool_, n)),
        end_known=draw(hnp.arrays(np.bool_, n)) & is_line,
    )
    texts = st.lists(WORDS, min_size=1, max_size=3).map(tuple)
    provenance = st.builds(Provenance, texts, texts, st.none() | FINITE)
    return SemanticMap(
        elements=elements,
        frame=MapFrame(
            draw(WORDS), draw(st.none() | st.tuples(FINITE, FINITE, FINITE)), draw(FINITE)
        ),
        classes=ClassSet((*DEFAULT_CLASSES, BEACON)),
        trajectory_m=draw(hnp.arrays(np.float64, (draw(st.integers(0, 4)), 3), elements=FINITE)),
        provenance=draw(st.just(()) | st.tuples(*[provenance] * n)),
        made_by=draw(WORDS),
        settings=draw(st.dictionaries(WORDS, st.none() | FINITE | WORDS, max_size=3)),
        operation=draw(st.integers(0, 2**53)),
    )


def small_map() -> SemanticMap:
    elements = Elements3D.from_ends([4], [[1.0, 2.0, 5.0]], [[1.0, 2.0, 0.0]], [POLE])
    return SemanticMap(elements, MapFrame("test"), made_by="by hand")


@given(maps())
def test_a_map_comes_back_bit_for_bit(semantic_map: SemanticMap) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "town.parquet"
        save_map(semantic_map, path)
        back = load_map(path)
    for field in fields(Elements3D):
        before, after = (
            getattr(semantic_map.elements, field.name),
            getattr(back.elements, field.name),
        )
        assert before.dtype == after.dtype
        assert before.tobytes() == after.tobytes()
    assert semantic_map.trajectory_m.tobytes() == back.trajectory_m.tobytes()
    for name in ("frame", "classes", "provenance", "made_by", "settings", "operation", "digest"):
        assert getattr(back, name) == getattr(semantic_map, name)


def test_saving_over_a_map_replaces_it_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "maps" / "town.parquet"
    for _ in range(2):
        save_map(small_map(), path)
    assert [file.name for file in path.parent.iterdir()] == ["town.parquet"]


def test_only_elements_of_detections_have_a_column_of_existence(tmp_path: Path) -> None:
    path = tmp_path / "town.parquet"
    for log_odds, existence in ((None, ""), (3.0, "95.2 %"), (7.0, "> 99.9 %"), (1e9, "> 99.9 %")):
        origin = Provenance(("a",), ("b",), log_odds)
        save_map(replace(small_map(), provenance=(origin,)), path)
        assert ("existence_log_odds" in pq.read_schema(path).names) == (log_odds is not None)
        assert load_map(path).provenance == (origin,)
        assert origin.existence == existence


def test_a_failed_save_leaves_the_old_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    before = path.read_bytes()

    def half_written(_table: object, where: Path, **_options: object) -> None:
        where.write_bytes(b"PAR1half")
        raise OSError("no space left on device")

    monkeypatch.setattr(pq, "write_table", half_written)
    with pytest.raises(SemvizError, match="no space"):
        save_map(small_map(), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match=r"town\.parquet: no such map"):
        load_map(tmp_path / "town.parquet")


def test_a_map_cut_at_any_byte_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(SemvizError, match="rebuild"):
            load_map(path)


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.parquet"
    text.write_text("id,class\n1,pole\n")
    with pytest.raises(SemvizError, match="not a readable Parquet file"):
        load_map(text)
    foreign = tmp_path / "foreign.parquet"
    pq.write_table(pa.table({"id": [1, 2]}), foreign)
    with pytest.raises(SemvizError, match="not a map of semviz"):
        load_map(foreign)


def rewritten(path: Path, **changes: object) -> None:
    """The map at ``path`` with other metadata."""
    table = pq.read_table(path)
    metadata = json.loads(table.schema.metadata[FORMAT.encode()]) | changes
    pq.write_table(table.replace_schema_metadata({FORMAT: json.dumps(metadata)}), path)


def test_a_newer_version_asks_for_an_update(tmp_path: Path) -> None:
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    rewritten(path, version=VERSION + 1)
    with pytest.raises(SemvizError, match=f"version {VERSION + 1}.*update"):
        load_map(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"frame": {}},
        {"frame": None},
        {"classes": [{"id": 0}]},
        {"trajectory_m": "AAAA"},
        {"operation": "last"},
    ],
)
def test_broken_metadata_is_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    rewritten(path, **changes)
    with pytest.raises(SemvizError, match="broken map"):
        load_map(path)


@pytest.mark.parametrize("column", ["id", "anchor_m", "covariance_m2", "label_ids"])
def test_a_missing_column_is_refused(tmp_path: Path, column: str) -> None:
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    pq.write_table(pq.read_table(path).drop_columns([column]), path)
    with pytest.raises(SemvizError, match=f"broken map.*{column}"):
        load_map(path)


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("id", pa.array([7, 7])),
        ("class_id", pa.array([0, 99])),
        ("anchor_m", pa.array([1.0, 2.0])),
        ("anchor_m", pa.array([[0.0, 0.0, np.nan]] * 2, pa.list_(pa.float64(), 3))),
        ("anchor_m", pa.array([None] * 2, pa.list_(pa.float64(), 3))),
    ],
)
def test_what_a_foreign_hand_wrote_is_refused_by_name(
    tmp_path: Path, column: str, values: pa.Array
) -> None:
    """One line that names the file, whatever is wrong inside it."""
    path = tmp_path / "town.parquet"
    ends = [[1.0, 2.0, 5.0], [9.0, 2.0, 5.0]]
    save_map(SemanticMap(Elements3D.from_ends([4, 5], ends, ends, [POLE] * 2), MapFrame("a")), path)
    table = pq.read_table(path)
    broken = table.set_column(table.schema.get_field_index(column), column, values)
    pq.write_table(broken.replace_schema_metadata(table.schema.metadata), path)
    with pytest.raises(SemvizError) as refused:
        load_map(path)
    assert str(refused.value).startswith(f"{path}: broken map (")
    assert "\n" not in str(refused.value)


def test_a_damaged_footer_is_one_line(tmp_path: Path) -> None:
    """Arrow explains some damage over several lines."""
    path = tmp_path / "town.parquet"
    save_map(small_map(), path)
    whole = path.read_bytes()
    reasons = []
    for position in range(len(whole) - 4000, len(whole), 37):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            load_map(path)
        except SemvizError as refused:
            reasons.append(str(refused))
    assert reasons
    assert not [reason for reason in reasons if "\n" in reason]


def test_a_flipped_bit_never_gives_another_map(tmp_path: Path) -> None:
    """What differs is refused in one line; Parquet itself notices only some of it."""
    path, rng = tmp_path / "map.parquet", random.Random(1)
    semantic_map = Street(7).truth_map
    save_map(semantic_map, path)
    content = path.read_bytes()
    refused = 0
    for _ in range(600):
        place, bit = rng.randrange(len(content)), rng.randrange(8)
        path.write_bytes(
            content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]
        )
        try:
            assert_same(load_map(path), semantic_map)
        except SemvizError as error:
            refused += str(error).startswith(f"{path}: ")
    assert refused > 300


def test_a_map_without_a_checksum_opens(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    semantic_map = Street(7).truth_map
    save_map(semantic_map, path)
    table = pq.read_table(path)
    metadata = json.loads(table.schema.metadata[b"semviz-map"])
    del metadata["crc32"]
    pq.write_table(table.replace_schema_metadata({"semviz-map": json.dumps(metadata)}), path)
    assert_same(load_map(path), semantic_map)
    metadata["operation"] += 1
    metadata["crc32"] = 1
    pq.write_table(table.replace_schema_metadata({"semviz-map": json.dumps(metadata)}), path)
    with pytest.raises(SemvizError, match="its checksum differs"):
        load_map(path)

"""A collection names drives; several people may add to it at once."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from streets import street_workspace

from semviz.collection.collection import Collection, Drive
from semviz_core.common import store as stores
from semviz_core.common.errors import SemvizError


@pytest.fixture(params=["folder", "s3"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(
        tmp_path / "city" if request.param == "folder" else request.getfixturevalue("s3_place")
    )


@pytest.fixture(scope="module")
def workspaces(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("drives")
    paths = [folder / name for name in ("may", "june", "july")]
    for seed, path in enumerate(paths):
        street_workspace(path, seed, 2)
    return paths


def test_drives_are_those_that_were_added(where: str, workspaces: list[Path]) -> None:
    may, june, july = workspaces
    Collection.create(where, [may])
    Collection.open(where).add([f"by night={july}"])
    assert Collection.open(where).add([june]) == (Drive("june", str(june)),)
    drives = (Drive("by night", str(july)), Drive("june", str(june)), Drive("may", str(may)))
    assert Collection.open(where).drives() == drives


def test_two_people_who_add_at_once_both_succeed(where: str, workspaces: list[Path]) -> None:
    Collection.create(where)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda path: Collection.open(where).add([path]), workspaces))
    assert {drive.name for drive in Collection.open(where).drives()} == {"may", "june", "july"}


def test_a_name_is_given_once(where: str, workspaces: list[Path], tmp_path: Path) -> None:
    may, june, _ = workspaces
    collection = Collection.create(where, [may])
    line = r"^the collection has a drive 'may' already; write NAME=WORKSPACE$"
    with pytest.raises(SemvizError, match=line):
        collection.add([june, may])
    shutil.copytree(may, tmp_path / "may")
    with pytest.raises(SemvizError, match=f"{may} is called 'may', too; write NAME="):
        collection.add([may, tmp_path / "may"])
    assert [drive.name for drive in collection.drives()] == ["may"]


def test_moved_together_drives_are_found(workspaces: list[Path], tmp_path: Path) -> None:
    shutil.copytree(workspaces[0], tmp_path / "all" / "may")
    Collection.create(tmp_path / "all" / "city", [tmp_path / "all" / "may"])
    (tmp_path / "all").rename(tmp_path / "moved")
    (drive,) = Collection.open(tmp_path / "moved" / "city").drives()
    assert drive.workspace == str(tmp_path / "moved" / "may")


def test_a_place_of_something_else_is_refused(
    where: str, workspaces: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(SemvizError, match=r"none: no such workspace"):
        Collection.create(where, [tmp_path / "none"])
    if not where.startswith("s3:"):
        assert not Path(where).exists()
    Collection.create(where)
    with pytest.raises(SemvizError, match=r"exists and is not empty|is a collection already"):
        Collection.create(where)
    with pytest.raises(SemvizError, match=r"no collection; make one with 'semviz collection cre"):
        Collection.open(workspaces[0])
    with pytest.raises(SemvizError, match="belongs to a workspace"):
        Collection.create(workspaces[0] / "maps")


@pytest.mark.parametrize("content", [b"", b"{}", b'{"format": "semviz-drive", "version": 2}'])
def test_a_damaged_drive_is_named(tmp_path: Path, content: bytes) -> None:
    collection = Collection.create(tmp_path / "city")
    collection.store.write_new("drives/may.json", content)
    with pytest.raises(SemvizError, match=r"city/drives/may.json: damaged, or of a newer semviz"):
        collection.drives()


def test_a_server_that_replaces_objects_is_refused(
    s3_place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores.ObjectStore, "write_new", lambda store, key, data: True)
    with pytest.raises(SemvizError, match=r"this object store replaces files.*\(If-None-Match\)"):
        Collection.create(s3_place)

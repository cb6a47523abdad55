"""Files of a store appear whole or not at all, once, and for one of several writers."""

import errno
import multiprocessing
import pickle
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from store_writers import write_number

from semviz_core.common import store as store_module
from semviz_core.common.errors import SemvizError
from semviz_core.common.store import Store


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "folder":
        return Store.at(tmp_path / "city", make=True)
    return Store.at(request.getfixturevalue("s3_place"))


def test_a_file_is_written_once_and_stays(store: Store) -> None:
    assert store.write_new("drives/may.json", b"first")
    assert not store.write_new("drives/may.json", b"second")
    assert store.read("drives/may.json") == b"first"


def test_what_is_removed_can_be_written_again(store: Store) -> None:
    store.write_new("runs/may", b"first")
    for _ in range(2):
        store.remove("runs/may")
        assert not store.exists("runs/may")
    assert store.write_new("runs/may", b"second")
    assert store.read("runs/may") == b"second"


def test_files_are_read_up_to_a_size(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "MOST_BYTES", 10)
    for size in (0, 10, 11):
        store.write_new(f"{size}", b"x" * size)
    assert [len(store.read(key)) for key in ("0", "10")] == [0, 10]
    with pytest.raises(SemvizError, match=r"11: more than .* MB"):
        store.read("11")


def test_files_on_disk_are_copied_whole(store: Store, tmp_path: Path) -> None:
    given, back = tmp_path / "given", tmp_path / "back"
    given.write_bytes(b"run")
    assert store.put_file_new("runs/a.rrd", given)
    given.write_bytes(b"another")
    assert not store.put_file_new("runs/a.rrd", given)
    back.write_bytes(b"older")
    store.fetch("runs/a.rrd", back)
    assert back.read_bytes() == b"run"


def test_keys_are_sorted_and_those_of_a_prefix(store: Store) -> None:
    assert store.keys() == store.keys("drives/") == []
    for key in ("drives/b", "a", "drives/a/c", "drives2"):
        store.write_new(key, b"")
    assert store.keys() == ["a", "drives/a/c", "drives/b", "drives2"]
    assert store.keys("drives/") == ["drives/a/c", "drives/b"]
    assert store.keys("drives") == ["drives/a/c", "drives/b", "drives2"]
    assert store.keys("drives/a") == ["drives/a/c"]
    assert store.exists("drives/b")
    assert not store.exists("drives")
    assert not store.exists("drives/c")


def test_what_is_missing_is_named_by_its_place(store: Store, tmp_path: Path) -> None:
    line = f"{store.where}/manifests/1.json: no such file"
    with pytest.raises(SemvizError, match=rf"^{line}$"):
        store.read("manifests/1.json")
    with pytest.raises(SemvizError, match=rf"^{line}$"):
        store.fetch("manifests/1.json", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    "key", ["", "/a", "a/", "a//b", "../a", "a/../b", ".a", "a/.b", "a\n", "a\\b"]
)
def test_keys_that_leave_the_store_are_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(SemvizError, match="cannot be a file of a store"):
        Store.at(tmp_path).write_new(key, b"")


def test_a_store_can_be_sent_to_another_process(store: Store) -> None:
    store.write_new("a", b"1")
    assert pickle.loads(pickle.dumps(store)).read("a") == b"1"


def test_one_of_several_writers_succeeds(store: Store) -> None:
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(3, spawn) as pool:
        won = list(pool.map(write_number, [store] * 12, range(10, 22)))
    assert won.count(True) == 1
    assert store.read("manifests/000001.json") == b"%d" % (10 + won.index(True)) * 100_000


def test_a_writer_that_is_killed_leaves_nothing_to_see(tmp_path: Path) -> None:
    script = (
        "import os, sys\n"
        "from semviz_core.common import files\n"
        "from semviz_core.common.store import Store\n"
        "files._fsync = lambda path: os.kill(os.getpid(), 9)\n"
        "Store.at(sys.argv[1]).write_new('a', b'half')\n"
    )
    assert subprocess.run([sys.executable, "-c", script, tmp_path]).returncode == -9
    store = Store.at(tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    assert store.keys() == []
    assert store.write_new("a", b"whole")


def test_a_full_disk_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "temporary")

    store = Store.at(tmp_path)
    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(shutil, "copyfile", full)
    line = rf"^{tmp_path}/a: cannot be written \(No space left on device\)$"
    with pytest.raises(SemvizError, match=line):
        store.write_new("a", b"")
    with pytest.raises(SemvizError, match=line):
        store.put_file_new("a", tmp_path / "b")
    assert not list(tmp_path.iterdir())


def test_a_conflict_of_s3_is_asked_again(s3_place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from botocore.exceptions import ClientError

    store = Store.at(s3_place)
    assert isinstance(store, store_module.ObjectStore)
    put, answers = store._files.pipe_file, iter([True, False])

    def conflicting(*arguments: object, **options: object) -> None:
        if next(answers):
            told = {"Error": {"Code": "ConditionalRequestConflict", "Message": "again"}}
            raise OSError(errno.EIO, "again") from ClientError(told, "PutObject")
        put(*arguments, **options)

    monkeypatch.setattr(store._files, "pipe_file", conflicting)
    monkeypatch.setattr(store_module, "CONFLICT_WAIT_S", 0.0)
    assert store.write_new("a", b"1")


def test_places_that_are_missing_are_named(
    s3_place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SemvizError, match=rf"^{tmp_path}/none: no such folder$"):
        Store.at(tmp_path / "none")
    with pytest.raises(SemvizError, match=r"^ftp://a: give a folder, or s3://BUCKET/PREFIX$"):
        Store.at("ftp://a")
    with pytest.raises(SemvizError, match=r"^s3://: write s3://BUCKET/PREFIX$"):
        Store.at("s3://")
    with pytest.raises(SemvizError, match=r"^s3://none/city: no such bucket$"):
        Store.at("s3://none/city")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    with pytest.raises(SemvizError, match=r"^s3://none/city: cannot be read \(Could not connect"):
        Store.at("s3://none/city")


def test_an_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semviz_core.common.errors.find_spec", lambda library: None)
    with pytest.raises(SemvizError, match=r"needs s3fs: pip install 'semviz\[cloud\]'"):
        Store.at("s3://bucket/city")

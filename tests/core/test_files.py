"""Files are whole or absent."""

import errno
import os
from pathlib import Path

import pytest

from semviz_core.common.errors import SemvizError
from semviz_core.common.files import new_folder, replacing


def test_what_was_written_takes_the_place(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.txt"
    with replacing(path) as temporary:
        temporary.write_text("one")
        assert not path.exists()
    assert path.read_text() == "one"
    assert list(path.parent.iterdir()) == [path]


def test_an_exception_leaves_everything_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_data_is_on_disk_before_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file.txt"
    synced: list[bool] = []

    def fsync(descriptor: int) -> None:
        is_folder = os.fstat(descriptor).st_ino == tmp_path.stat().st_ino
        synced.append(path.exists())
        assert is_folder == path.exists()  # file before the rename, folder after it

    monkeypatch.setattr(os, "fsync", fsync)
    with replacing(path) as temporary:
        temporary.write_text("one")
    assert synced == [False, True]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(SemvizError, match="cannot be written"), replacing(tmp_path / "file" / "x"):
        pass


def test_colleagues_may_read_what_the_umask_lets_them(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with replacing(tmp_path / "file.txt") as temporary:
            temporary.write_text("for the group")
    finally:
        os.umask(before)
    assert (tmp_path / "file.txt").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_only_a_file_is_replaced(tmp_path: Path, kind: str) -> None:
    """Written by an administrator, /dev/null must stay what it is."""
    target = tmp_path / "target"
    target.mkdir() if kind == "folder" else os.mkfifo(target)
    before = target.stat()
    with pytest.raises(SemvizError, match="not a file"), replacing(target):
        pass
    assert (target.stat().st_ino, target.stat().st_mode) == (before.st_ino, before.st_mode)
    assert list(tmp_path.iterdir()) == [target]


def test_a_full_disk_is_named_and_nothing_left(tmp_path: Path) -> None:
    target = tmp_path / "map.parquet"
    target.write_text("before")
    with pytest.raises(SemvizError, match=r"map\.parquet: cannot be written"), replacing(target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_appears_when_all_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "folder"
    with new_folder(path) as temporary:
        (temporary / "one").write_text("1")
        assert not path.exists()
    assert [file.name for file in path.iterdir()] == ["one"]
    with pytest.raises(SemvizError, match="already exists"), new_folder(path):
        raise AssertionError("nothing is to be written")
    with pytest.raises(RuntimeError), new_folder(tmp_path / "other"):
        raise RuntimeError("stopped")
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]

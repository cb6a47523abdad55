"""An open label file with its newest state in memory, and a watch over the file on disk.

The whole file is also checked in the background, slowly, so that no edit waits.
"""

import os
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from semviz_annotation.labels.labels import Draft, Labels
from semviz_annotation.storage import database, integrity, tables
from semviz_annotation.storage.database import DamagedError
from semviz_annotation.storage.integrity import check_labels
from semviz_annotation.storage.operations import NO_HASH, Operation
from semviz_core.base.classes import NEW_CENTER, TriangleCenter, describe_center
from semviz_core.common.errors import SemvizError

_Identity: TypeAlias = tuple[int, int]
"""Device and inode."""
Content: TypeAlias = tuple[int, int]
"""Time (ns) and size (bytes) of the last change of a file."""
REMEDY = "put it back, or restart semviz to use the file that is there"
CHECKPOINT_S = 1.0
"""How long to wait for another process's checkpoint."""


class OpenFile:
    """The files of an open database, as they were when it was opened.

    SQLite writes on into files that were removed, renamed or replaced; what it writes there is
    lost. A check costs 10 µs.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        real = path.resolve()  # SQLite writes its journal beside the target of a link
        files = [path, *(real.with_name(real.name + end) for end in ("-wal", "-shm"))]
        self._identities = [(str(file), _identity(file.stat())) for file in files]
        self._accepted = self.content()

    def check(self) -> None:
        """Raise SemvizError if one of the files is not the opened one any more."""
        for file, identity in self._identities:
            try:
                now = _identity(os.stat(file))  # noqa: PTH116 (a third of the time of Path.stat)
            except OSError:
                raise SemvizError(f"{Path(file).name} was removed while it was open") from None
            if now != identity:
                raise SemvizError(f"{Path(file).name} was replaced while it was open")

    def content(self) -> Content:
        """Return time and size of the last change of the file. Raise OSError if it is missing."""
        status = os.stat(self._path)  # noqa: PTH116
        return status.st_mtime_ns, status.st_size

    def has_new_content(self) -> bool:
        """Whether the file was written since ``accept_content``: by a checkpoint, or from outside.

        Raise OSError if it is missing.
        """
        return self.content() != self._accepted

    def accept_content(self) -> None:
        """Take the file's content as it is now for the database's own."""
        self._accepted = self.content()


def _identity(status: os.stat_result) -> _Identity:
    return status.st_dev, status.st_ino


class _Written(NamedTuple):
    """An operation, with the state and the digest of all rows after it."""

    operation: Operation
    labels: Labels
    digest: int


class LabelFileError(SemvizError):
    """The label file cannot be read or written now; no edit is to blame. A retry may succeed."""


class NotSavedError(LabelFileError):
    """An edit is not saved: the disk refused it, or the file is locked, damaged or missing."""


class LabelFile:
    """An open label file. Within ``reading`` and ``writing``, its attributes match the disk.

    Raise LabelFileError if the file cannot be opened, or is damaged.
    """

    def __init__(self, path: Path, center: TriangleCenter = NEW_CENTER) -> None:
        self.path = path
        self.labels = Labels()
        self.hash = NO_HASH
        """Hash of the last operation."""
        self.history = tables.UndoHistory()
        self.version = 0
        """Increases when another process replaced the content, or wrote it into the file."""
        self.damage = ""
        """Why the file is damaged, as far as known; it accepts no edits then."""
        self.connection = database.connect(path, center)
        self._lock = threading.RLock()
        self._data_version: int | None = None
        self._digest = 0
        self._number_in_file = 0
        """The last operation in the file alone, without its journal; it never decreases."""
        self._former: tuple[int, str] | None = None
        """Number and hash of that operation when the content was read or replaced as a whole."""
        self._foreign: Content | None = None
        """Content that is not of this database."""
        self._written: list[_Written] = []
        try:
            with self.reading():
                pass
            self._open_file = OpenFile(path)
            self._number_in_file, _ = self._former or (0, "")
        except (OSError, *database.UNREADABLE) as error:
            self.connection.close()
            raise LabelFileError(f"{path}: cannot be read ({error})") from None
        except BaseException:
            self.connection.close()
            raise
        self._guard = integrity.open_read_only(path)
        """While it is open, closing ``connection`` does not write its journal to the file."""
        self._guard.execute("SELECT count(*) FROM counters").fetchone()

    def close(self) -> None:
        with self._lock:
            try:
                is_overwritten = self._is_overwritten()
            except OSError:  # it was removed
                is_overwritten = False
            if not is_overwritten:
                self._guard.close()
            self.connection.close()
            self._guard.close()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read the newest state in one transaction, isolated from other writers."""
        with self._transaction("BEGIN", "Not read", LabelFileError):
            yield

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Write in one transaction on the newest state: durable at the end, or nothing is written.

        Waits for other writers. Raise NotSavedError if the file cannot be written, is damaged, or
        is no longer the one at its path. In that last case alone the file that was opened may
        have the edit.
        """
        with self._lock:
            self.check_usable()
            self._written = []
            with self._transaction("BEGIN IMMEDIATE", "Not saved", NotSavedError):
                yield
            self._advance(self._written)
            self._check_at_path()
            if self._open_file.has_new_content():  # by a checkpoint of this commit
                self._accept_content(integrity.last_in_file(self.path)[0])

    def check_usable(self) -> None:
        """Raise LabelFileError if what is written now would be lost. It costs 20 µs."""
        with self._lock:
            self._check_at_path()
            if self.damage or self._open_file.has_new_content():
                try:
                    with self.reading():  # a backup may have been restored
                        pass
                except LabelFileError:
                    self._check_content()  # another file seems damaged under this one's journal
                    raise
            self._check_content()
            if self.damage:
                raise NotSavedError(self.damage)

    def _check_content(self) -> None:
        if self._is_overwritten():
            raise NotSavedError(
                f"Not saved: {self.path.name} was overwritten while it was open; {REMEDY}."
            )

    def _check_at_path(self) -> None:
        try:
            self._open_file.check()
        except SemvizError as error:
            raise NotSavedError(f"Not saved: {error}; {REMEDY}.") from None

    def _is_overwritten(self) -> bool:
        """Whether another file was copied over the open one, not a checkpoint of any process."""
        deadline = time.monotonic() + CHECKPOINT_S
        while self._open_file.has_new_content():
            content = self._open_file.content()
            if content == self._foreign:
                return True
            with suppress(SemvizError, *database.UNREADABLE):
                number, hash_ = integrity.last_in_file(self.path)
                is_ours = tables.hash_of(self.connection, number) == hash_
                if (is_ours and number >= self._number_in_file) or (number, hash_) == self._former:
                    integrity.check_again(self.path, self.labels.operation, self.hash)
                    self._accept_content(number)
                    self.version += 1  # a reason to check everything again
                    return False
            if time.monotonic() > deadline:
                self._foreign = content
            time.sleep(0.02)
        return False

    def _accept_content(self, number_in_file: int) -> None:
        self._number_in_file = number_in_file
        if self._former is not None and number_in_file != self._former[0]:
            self._former = None
        self._open_file.accept_content()

    def contains(self, number: int, hash_: str) -> bool:
        """Whether ``hash_`` is that of operation ``number``."""
        with self.reading():
            return tables.hash_of(self.connection, number) == hash_

    def report_damage(self, why: str, version: int) -> None:
        """Refuse edits from now on, because a check of ``version`` found damage."""
        with self._lock, suppress(LabelFileError):
            self.check_usable()  # or another file was checked
            if self.version == version:
                self.damage = why

    def with_triangles_at(self, center: TriangleCenter) -> Labels:
        """Return the state with triangular signs marked at ``center``, within ``writing``.

        Raise SemvizError if there are labels that mark something else.
        """
        present = self.labels.triangle_center
        if center == present:
            return self.labels
        if self.labels.operation:
            raise SemvizError(
                f"it marks triangular signs at {describe_center(center)}, but {self.path} at "
                f"{describe_center(present)}"
            )
        database.define_triangles(self.connection, center)
        return replace(self.labels, triangle_center=center)

    def append(self, operation: Operation, labels: Labels) -> None:
        """Write an operation that leads to ``labels``, within ``writing``."""
        tables.write_operation(self.connection, operation)
        tables.write_changes(self.connection, operation.changes, labels.next_number)
        before = self._written[-1].digest if self._written else self._digest
        digest = integrity.digest_after(before, operation.changes)
        integrity.write_digest(self.connection, digest, operation.number)
        self._written.append(_Written(operation, labels, digest))

    def labels_at(self, number: int) -> Labels:
        """Return the state after an operation, computed from the nearer end of the log; 0: start.

        Raise SemvizError if there is no such operation.
        """
        last = self.labels.operation
        if not 0 <= number <= last:
            raise SemvizError(f"there is no operation {number}; the last one is {last}")
        if number > last // 2:
            labels = tables.rewound(self.labels, tables.read_operations(self.connection, number))
        else:
            earlier = tables.read_operations(self.connection, before=number + 1)
            labels = tables.replayed(earlier, self.labels)
        return replace(labels, operation=number)

    @contextmanager
    def _transaction(self, begin: str, refused: str, kind: type[SemvizError]) -> Iterator[None]:
        """Run a transaction. If SQLite fails, raise ``kind``: its message begins ``refused``."""
        with self._lock:
            try:
                self.connection.execute(begin)
                try:
                    self._catch_up(kind)
                    yield
                    self.connection.execute("COMMIT")
                except BaseException:
                    if self.connection.in_transaction:
                        self.connection.execute("ROLLBACK")
                    raise
            except UnicodeEncodeError:
                raise SemvizError(
                    f"{refused}: a text has characters that are not Unicode."
                ) from None
            except database.UNREADABLE as error:
                raise kind(str(database.database_error(error, self.path, refused))) from None

    def _catch_up(self, kind: type[SemvizError]) -> None:
        """Read what other processes have written since, or a backup they restored."""
        (version,) = self.connection.execute("PRAGMA data_version").fetchone()
        if version == self._data_version:
            return
        try:
            self._follow_or_load()
        except SemvizError as error:
            raise kind(str(database.damaged(self.path, str(error)))) from None
        self._data_version = version

    def _follow_or_load(self) -> None:
        known = self.labels.operation
        if not known or tables.hash_of(self.connection, known) != self.hash:
            self._load()
            return
        newer = tuple(tables.read_operations(self.connection, known))
        draft, digest, written = Draft(self.labels), self._digest, []
        for operation in newer:
            draft.apply(operation.changes)
            digest = integrity.digest_after(digest, operation.changes)
            written.append(_Written(operation, draft.labels(), digest))
        if newer:
            integrity.check_following(
                newer[-integrity.TAIL :], _hash_before(newer, self.hash), draft.labels()
            )
            integrity.check_digest(self.connection, newer[-1].number, digest)
        self._advance(written)

    def _load(self) -> None:
        labels = tables.read_labels(self.connection)
        digest = integrity.digest_of(labels.rows())
        integrity.check_opened(self.connection, labels, digest)
        history = tables.read_history(self.connection)
        self.labels, self.history = labels, history
        self.hash = tables.hash_of(self.connection, labels.operation) or NO_HASH
        self._digest = digest
        self.version += 1
        self.damage = ""
        self._number_in_file, self._former = 0, None
        with suppress(*database.UNREADABLE):
            self._former = integrity.last_in_file(self.path)

    def _advance(self, written: Iterable[_Written]) -> None:
        for operation, labels, digest in written:
            self.labels = replace(labels, operation=operation.number)
            self.hash = operation.hash
            self.history.add(operation)
            self._digest = digest


def _hash_before(operations: tuple[Operation, ...], hash_before: str) -> str:
    """Return the hash before the last ``TAIL`` of ``operations``, which follow ``hash_before``."""
    return (
        hash_before if len(operations) <= integrity.TAIL else operations[-integrity.TAIL - 1].hash
    )


HealthState: TypeAlias = Literal["checking", "sound", "damaged", "missing"]


@dataclass(frozen=True)
class Health:
    """What is known about an open label file."""

    state: HealthState
    """``missing``: removed or replaced while open; ``damaged`` and ``missing`` accept no edits."""
    text: str
    """One line for people; empty while all is well."""


WORK_S, REST_S = 0.003, 0.009
"""The check works a quarter of the time, a few milliseconds at once."""
RETRY_S = 5.0


class BackgroundCheck:
    """Checks a label file completely in a thread: when opened, and when a backup was restored."""

    def __init__(self, file: LabelFile) -> None:
        self._file = file
        self._closing = threading.Event()
        self._since = time.monotonic()
        self._checked = -1
        """The version of the file that was found sound."""
        self._thread = threading.Thread(target=self._run, name="semviz-check", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def health(self) -> Health:
        """Return what is known now; it costs 20 µs."""
        try:
            self._file.check_usable()
        except NotSavedError as error:
            return Health("damaged" if self._file.damage else "missing", str(error))
        except LabelFileError as error:
            return Health("damaged", str(error))
        return Health("sound" if self._checked == self._file.version else "checking", "")

    def _run(self) -> None:
        while not self._closing.is_set():
            version = self._file.version
            if version != self._checked and not self._file.damage:
                self._check(version)
            self._closing.wait(RETRY_S if version != self._checked else 0.2)

    def _check(self, version: int) -> None:
        try:
            found = check_labels(self._file.path, self._pace)
            if self._file.contains(found.operations, found.hash):
                self._checked = version
        except DamagedError as error:
            self._file.report_damage(str(error), version)
        except (SemvizError, _StoppedError):
            pass  # locked or closed

    def _pace(self) -> None:
        if time.monotonic() - self._since > WORK_S:
            if self._closing.wait(REST_S):
                raise _StoppedError
            self._since = time.monotonic()


class _StoppedError(Exception):
    """The file is closed."""

"""Read the classes that a label file declares, without its labels."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from semviz_annotation.labels.own_classes import class_set
from semviz_annotation.labels.rows import FIRST_OWN_CLASS, TAGS, ClassDeclaration
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.common.errors import SemvizError


def read_classes(path: Path) -> ClassSet:
    """Return the classes of a label file, those of every workspace if it is missing.

    Raise SemvizError if they cannot be read.
    """
    if not path.is_file():
        return DEFAULT_CLASSES
    uri = f"{path.resolve().as_uri()}?mode=ro"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            return class_set(tuple(read_declarations(connection)))
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise SemvizError(f"{path}: its classes cannot be read ({error})") from None


def read_declarations(connection: sqlite3.Connection) -> Iterator[ClassDeclaration]:
    """Return the classes of a file's own; files of earlier versions have none."""
    has_some = "SELECT 1 FROM sqlite_master WHERE name = 'declarations'"
    if connection.execute(has_some).fetchone():
        for row in connection.execute("SELECT * FROM declarations"):
            yield ClassDeclaration(*row)


def free_class_id(connection: sqlite3.Connection) -> int:
    """Return an id that no class ever had."""
    (last,) = connection.execute(
        "SELECT max(CAST(row_id AS INTEGER)) FROM writers WHERE row_tag = ?",
        (TAGS[ClassDeclaration],),
    ).fetchone()
    return FIRST_OWN_CLASS if last is None else last + 1

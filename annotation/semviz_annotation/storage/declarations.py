"""The classes that a label file declares, in its tables."""

import sqlite3
from collections.abc import Iterator

from semviz_annotation.labels.rows import FIRST_OWN_CLASS, TAGS, ClassDeclaration


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

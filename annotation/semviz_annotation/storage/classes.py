"""Read the classes of a label file, without its labels."""

import sqlite3
from contextlib import closing
from pathlib import Path

from semviz_annotation.labels.own_classes import class_set
from semviz_annotation.storage.database import database_error
from semviz_annotation.storage.declarations import read_declarations
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet


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
        raise database_error(error, path, "Classes not read") from None

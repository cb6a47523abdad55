"""TOML files that say how to read somebody's model."""

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from semviz_core.errors import SemvizError

Settings = TypeVar("Settings", bound=BaseModel)


def read_settings(path: Path, kind: type[Settings]) -> Settings:
    """Raises SemvizError where the file cannot be read, or says something else than ``kind``."""
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SemvizError(f"{path}: no such file; it says how to read a model") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise SemvizError(f"{path}: not readable as TOML ({error}); repair it") from None
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise SemvizError(f"{path}: {first_fault(error)}; repair it") from None


def first_fault(error: ValidationError) -> str:
    """Where it is and what, for people."""
    first = error.errors()[0]
    told = first["msg"].removeprefix("Value error, ")
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {told}" if where else told

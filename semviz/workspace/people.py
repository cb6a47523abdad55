"""Who may label a workspace: the file ``people.json``, with a token for each person.

Tokens are shown once, when they are made; the file holds their digests and is private. Who reads
it can act for these people, as who reads the process's memory can. An invitation and its end are
operations of the label log, too; the file alone decides who may enter.
"""

import hashlib
import json
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, read_limited

FILE = "people.json"
Role: TypeAlias = Literal["annotate", "review", "look"]
"""What a person may do: label; label and review; or look."""
Name: TypeAlias = Annotated[str, Field(pattern=r"^[\w.-][\w .-]{0,38}[\w.-]$|^[\w.-]$")]


@dataclass(frozen=True)
class Person:
    """Somebody who was invited."""

    name: Name
    role: Role
    digest: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    """SHA-256 of the token."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(strict=True, extra="forbid")


@dataclass(frozen=True)
class _Content:
    format: Literal["semviz-people"]
    version: Literal[1]
    people: tuple[Person, ...]

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(strict=True, extra="forbid")


_CONTENT = TypeAdapter(_Content)
_NAME = TypeAdapter(Name)


def digest_of(token: str) -> str:
    """Return the digest that stands for a token."""
    return hashlib.sha256(token.encode(errors="backslashreplace")).hexdigest()


class People:
    """The people of one workspace. Any thread; other processes may change the file."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._read: tuple[tuple[int, int], Mapping[str, Person]] | None = None

    def by_name(self) -> Mapping[str, Person]:
        """Return all people by name. Raise SemvizError if the file is damaged."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return {}
        stamp = status.st_mtime_ns, status.st_ino
        if self._read is None or self._read[0] != stamp:
            self._read = stamp, {person.name: person for person in self._load()}
        return self._read[1]

    def names_by_digest(self) -> Mapping[str, str]:
        """Return the names by the digests of their tokens; nobody if the file is damaged."""
        try:
            return {person.digest: person.name for person in self.by_name().values()}
        except SemvizError:
            return {}

    def invite(self, name: str, role: Role) -> str:
        """Return a new token for a person; one who was invited before gets it instead of the old.

        Raise SemvizError if the name is unusable.
        """
        try:
            _NAME.validate_python(name)
        except ValidationError:
            raise SemvizError(
                f"'{name}' is no name: 1 to 40 letters, digits, dots, dashes and spaces inside"
            ) from None
        token = secrets.token_urlsafe(16)
        others = [person for person in self.by_name().values() if person.name != name]
        self._write([*others, Person(name, role, digest_of(token))])
        return token

    def revoke(self, name: str) -> None:
        """End a person's access at once. Raise SemvizError if nobody has this name."""
        people = self.by_name()
        if name not in people:
            known = ", ".join(people) or "nobody"
            raise SemvizError(f"nobody named '{name}' is invited; invited: {known}")
        self._write([person for person in people.values() if person.name != name])

    def _load(self) -> tuple[Person, ...]:
        try:
            return _CONTENT.validate_json(read_limited(self._path, MOST_TEXT_BYTES)).people
        except ValidationError:
            raise SemvizError(
                f"{self._path}: not a file of people; remove it and invite them again"
            ) from None

    def _write(self, people: list[Person]) -> None:
        content = asdict(_Content("semviz-people", 1, tuple(people)))
        with replacing(self._path) as temporary:
            temporary.touch(mode=0o600)
            temporary.chmod(0o600)
            temporary.write_text(json.dumps(content, indent=1) + "\n")

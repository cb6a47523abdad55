"""Which images a detector looked at: where it proposes nothing there, it found nothing."""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_annotation.rows import Index
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

Setting = str | int | float | bool | None


@dataclass(frozen=True)
class Looked:
    """What a detector, the last that ``semviz detect`` ran, has done so far."""

    detector: str
    """Its name; proposals of this name are its own."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """With others it would find other things."""
    images: frozenset[tuple[int, Side]] = frozenset()
    """Frame indices and sides of the images it looked at."""

    def as_json(self) -> str:
        frames = {
            side: sorted(index for index, one in self.images if one == side)
            for side in ("left", "right")
        }
        document = _Document(detector=self.detector, settings=self.settings, **frames)
        return document.model_dump_json()

    @classmethod
    def from_json(cls, text: str | bytes) -> "Looked":
        """Raises SemvizError where it is none."""
        try:
            read = _Document.model_validate_json(text)
        except ValidationError:
            raise SemvizError("what it says of its detector is not readable") from None
        left: set[tuple[int, Side]] = {(index, "left") for index in read.left}
        right: set[tuple[int, Side]] = {(index, "right") for index in read.right}
        return cls(read.detector, read.settings, frozenset(left | right))


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    detector: Annotated[str, Field(min_length=1, max_length=100)]
    settings: dict[str, Setting]
    left: list[Index]
    right: list[Index]

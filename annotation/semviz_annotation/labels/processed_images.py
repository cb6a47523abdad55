"""Records which images a detector has processed, so that no proposal means no detection."""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_annotation.labels.rows import Index
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

Setting = str | int | float | bool | None


@dataclass(frozen=True)
class ProcessedImages:
    """The last detector that ``semviz detect`` ran, and the images it has processed so far."""

    detector: str
    """Name of the detector, as in its proposals."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """Settings that its detections depend on."""
    images: frozenset[tuple[int, Side]] = frozenset()
    """Frame index and side of each processed image."""

    def as_json(self) -> str:
        frames = {
            side: sorted(index for index, image_side in self.images if image_side == side)
            for side in ("left", "right")
        }
        document = _ProcessedImagesFile(detector=self.detector, settings=self.settings, **frames)
        return document.model_dump_json()

    @classmethod
    def from_json(cls, text: str | bytes) -> "ProcessedImages":
        """Read the text of ``as_json``. Raise SemvizError if it is invalid."""
        try:
            document = _ProcessedImagesFile.model_validate_json(text)
        except ValidationError:
            raise SemvizError("its record of processed images is not readable") from None
        left: set[tuple[int, Side]] = {(index, "left") for index in document.left}
        right: set[tuple[int, Side]] = {(index, "right") for index in document.right}
        return cls(document.detector, document.settings, frozenset(left | right))


class _ProcessedImagesFile(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    detector: Annotated[str, Field(min_length=1, max_length=100)]
    settings: dict[str, Setting]
    left: list[Index]
    right: list[Index]

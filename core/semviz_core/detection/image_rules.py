"""How a transformers model wants its images: what its ``preprocessor_config.json`` says."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from semviz_core.detection.model_input import LARGEST_SIDE, ModelInput
from semviz_core.detection.settings_file import first_fault
from semviz_core.errors import SemvizError

FILE = "preprocessor_config.json"


class Size(BaseModel):
    """To resize to: width and height, or the sides of an image whose proportions are kept."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    height: int | None = None
    width: int | None = None
    shortest_edge: int | None = None
    longest_edge: int | None = None

    def of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of what an image becomes."""
        if self.width and self.height:
            return self.width, self.height
        longest, shortest = self.longest_edge or LARGEST_SIDE, self.shortest_edge or LARGEST_SIDE
        scale = min(shortest / min(width, height), longest / max(width, height))
        return round(width * scale), round(height * scale)


class ImageRules(BaseModel):
    """What of the file is about the image itself; other keys are for other tasks."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    do_resize: bool = True
    size: Size = Size()
    do_rescale: bool = True
    rescale_factor: float = 1.0 / 255.0
    do_normalize: bool = True
    image_mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    image_std: tuple[float, float, float] = (0.229, 0.224, 0.225)

    def model_input(self, width: int, height: int) -> ModelInput:
        """For an image of that size. Raises SemvizError where none can be made of it."""
        resized = self.do_resize and self.size != Size()
        columns, rows = self.size.of(width, height) if resized else (width, height)
        try:
            return ModelInput(
                width=columns,
                height=rows,
                resize="stretch",
                scale=self.rescale_factor if self.do_rescale else 1.0,
                mean=self.image_mean if self.do_normalize else (0.0, 0.0, 0.0),
                std=self.image_std if self.do_normalize else (1.0, 1.0, 1.0),
            )
        except ValidationError as error:
            raise SemvizError(
                f"an image of {width} x {height} would become {columns} x {rows} "
                f"({first_fault(error)})"
            ) from None


def read_image_rules(folder: Path) -> ImageRules:
    """Raises SemvizError where the file is missing or says what is not understood."""
    path = folder / FILE
    try:
        return ImageRules.model_validate_json(path.read_bytes())
    except OSError:
        raise SemvizError(f"{path}: cannot be read; it says how the model wants images") from None
    except ValidationError as error:
        raise SemvizError(f"{path}: {first_fault(error)}; save it with a newer version") from None

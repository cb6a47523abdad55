"""Where pixels of a workspace's images are in the images as recorded."""

from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.table import OriginalPixels
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.own_drive.image_folder import ImageFolder


def original_pixels(workspace: Workspace) -> OriginalPixels:
    """Return the way back to recorded images, which only own drives have apart."""
    source = workspace.source

    def to_original(index: int, side: Side, pixels_px: FloatArray) -> tuple[str, FloatArray]:
        if isinstance(source, ImageFolder):
            name = source.original_path(index, side).name
            return name, source.to_original(pixels_px, side)
        return f"{side}/{index:06d}.png", pixels_px

    return to_original

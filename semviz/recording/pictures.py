"""The images of a run: taken from its source when it is recorded, found again when it is shown."""

import os
from dataclasses import replace
from pathlib import Path

from semviz.recording.run import FrameRecord, Images, Run
from semviz_core.errors import SemvizError
from semviz_core.sources.kitti import KittiSequence
from semviz_core.sources.source import Side, Source

JPEG_QUALITY = 90
_STARTS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")
"""Of JPEG and PNG files: a run must not make us hand out anything else."""


def check_offered(source: Source, images: Images) -> None:
    """SemvizError where a source does not have what ``--images`` asks for."""
    if images == "both" and source.rig.right is None:
        raise SemvizError("--images both: the sequence has one camera; leave the option out")
    if images == "reference" and not isinstance(source, KittiSequence):
        raise SemvizError(
            "--images reference: the images of a simulated street are not in files; "
            "choose embedded, both or none"
        )


def with_pictures(record: FrameRecord, source: Source, images: Images, folder: Path) -> FrameRecord:
    """The frame with its images, or their names, for a run that is in ``folder``."""
    index = record.frame.index
    has_right = source.rig.right is not None
    match images:
        case "none":
            return record
        case "reference":
            assert isinstance(source, KittiSequence)
            left = _named(source.image_path(index, "left"), folder)
            right = _named(source.image_path(index, "right"), folder) if has_right else ""
            return replace(record, image_file=left, image_right_file=right)
        case "embedded":
            return replace(record, image=_jpeg(source, index, "left"))
        case "both":
            right_jpeg = _jpeg(source, index, "right")
            return replace(record, image=_jpeg(source, index, "left"), image_right=right_jpeg)


def picture(run: Run, path: Path, position: int, side: Side) -> bytes | None:
    """An image of the frame at ``position`` of the run in ``path``, as JPEG or PNG.

    None where it was left out or its file is not to be had: ``why_no_picture`` says which.
    """
    record = run.frames[position]
    embedded = record.image if side == "left" else record.image_right
    if embedded is not None:
        return embedded
    file = _file(record, path, side)
    try:
        data = b"" if file is None else file.read_bytes()
    except OSError:
        return None
    return data if data.startswith(_STARTS) else None


def why_no_picture(run: Run, path: Path, position: int, side: Side) -> str:
    """One line for people on an image that ``picture`` does not give."""
    file = _file(run.frames[position], path, side)
    if file is None:
        also = " of the right camera" if side == "right" else ""
        return f"This run was recorded without images{also}."
    if file.is_file():
        return f"{file}: the run names this image, but it cannot be read."
    return f"{file}: the run names this image, but it is not there any more."


def seen_from(folder: Path, record: FrameRecord, before: Path) -> FrameRecord:
    """The frame of a run that was in the folder ``before``, with its images' names seen anew."""
    names = [
        _named(before.resolve() / name, folder) if name else ""
        for name in (record.image_file, record.image_right_file)
    ]
    return replace(record, image_file=names[0], image_right_file=names[1])


def _file(record: FrameRecord, path: Path, side: Side) -> Path | None:
    """Where the run in ``path`` says that an image is."""
    name = record.image_file if side == "left" else record.image_right_file
    return Path(os.path.normpath(path.resolve().parent / name)) if name else None


def _named(file: Path, folder: Path) -> str:
    """As seen from ``folder``, so that both can move together; absolute where nothing is shared."""
    file, folder = file.resolve(), folder.resolve()
    shared = Path(os.path.commonpath([file, folder]))
    return str(file) if shared == Path(file.anchor) else os.path.relpath(file, folder)


def _jpeg(source: Source, index: int, side: Side) -> bytes:
    import cv2

    image = source.image(index, side)
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", image[:, :, ::-1], quality)[1].tobytes()

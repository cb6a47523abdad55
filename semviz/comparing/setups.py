"""What two runs were made with, side by side: the same, or each one's own."""

from collections.abc import Iterator
from typing import NamedTuple

from semviz.measure import settings_of
from semviz.recording.run import FrameRecord, Run


class Setup(NamedTuple):
    """One thing that runs are made with, in words; equal where it was the same."""

    what: str
    base: str
    other: str


def setups(base: Run, other: Run) -> tuple[Setup, ...]:
    """Map, labels, method and settings, images, version; of settings those that differ."""
    mine, theirs = settings_of(base), settings_of(other)
    named = ("method", "observations", "seed")
    return (
        Setup("Map", *_maps(base, other)),
        Setup("Labels", _labels(base), _labels(other)),
        *(Setup(what.capitalize(), mine[what], theirs[what]) for what in named),
        *_options(base, other),
        Setup("Images", *_images(base, other)),
        Setup("semviz", mine["semviz"], theirs["semviz"]),
    )


def _maps(base: Run, other: Run) -> tuple[str, str]:
    """Names; with some of their contents' digest where two of one name differ."""
    names = base.info.map_name, other.info.map_name
    digests = base.semantic_map.digest, other.semantic_map.digest
    if digests[0] == digests[1]:
        return names[1], names[1]
    if names[0] != names[1]:
        return names
    return f"{names[0]} ({digests[0][:6]})", f"{names[1]} ({digests[1][:6]})"


def _labels(run: Run) -> str:
    operation = run.semantic_map.operation
    return f"operation {operation}" if operation else "none"


def _options(base: Run, other: Run) -> Iterator[Setup]:
    mine, theirs = base.info.options, other.info.options
    names = dict.fromkeys([*mine, *theirs])
    differ = [name for name in names if mine.get(name) != theirs.get(name)]
    for name in differ:
        yield Setup(name, str(mine.get(name, "-")), str(theirs.get(name, "-")))
    if not differ:
        yield Setup("Settings", "", "")


def _images(base: Run, other: Run) -> tuple[str, str]:
    """Of the frames in both; whether they are the same pictures is told where that is at hand."""
    mine = {one.frame.index: _picture(one) for one in base.frames}
    pairs = [
        (mine[one.frame.index], _picture(one)) for one in other.frames if one.frame.index in mine
    ]
    here, there = (sum(pair[side] is not None for pair in pairs) for side in (0, 1))
    others = sum(type(a) is type(b) and a != b for a, b in pairs)
    said = f", {others} of them otherwise" if others else ""
    return _counted(here), _counted(there) + said


def _picture(record: FrameRecord) -> bytes | str | None:
    """The left image or the name of its file."""
    return record.image or record.image_file or None


def _counted(frames: int) -> str:
    return f"{frames} {'frame' if frames == 1 else 'frames'}" if frames else "none"

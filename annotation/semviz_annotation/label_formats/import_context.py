"""What a file of labels is read against: the classes, frames, images and cameras of a workspace.

Names of classes and images become those of the workspace, and a shape drawn in an image of another
size, or in a recorded image with its distortion, becomes a mark in the labelled image.
"""

import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from semviz_annotation.label_formats.reading import (
    IGNORE,
    MOST_ITEMS,
    SIGNS_OF_ANY_SHAPE,
    ParsedLabels,
    ParsedObservation,
    at,
    class_named,
    quoted,
)
from semviz_annotation.label_formats.shapes import DrawnShape, axis, centroid, outline_of
from semviz_annotation.labels.rows import Observation, Pixel, Rules, is_id
from semviz_core.base.classes import OLDER_CENTER, RECTANGULAR, TRIANGULAR, TriangleCenter
from semviz_core.base.frame import Dataset, Side
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder

OTHERS = "*"
"""Name in a class map of all classes that are neither mapped nor known."""
_LEAST_SCALE = 1.02
"""Images of nearly the same size are others, not scaled ones: KITTI's raw and its odometry."""
_MOST_NAMED = 40
"""Largest number of unknown classes in an error."""
PixelsOf: TypeAlias = Literal["recorded", "rectified"]

_SIDES: Mapping[str, Side] = {
    "left": "left", "image_0": "left", "image_2": "left", "image_00": "left", "image_02": "left",
    "right": "right", "image_1": "right", "image_3": "right", "image_01": "right",
    "image_03": "right",
}  # fmt: skip
_OURS = re.compile(r"(^|/)(left|right)/\d{6}\.\w+$")
"""Name of an image as semviz writes it."""
_ADDED = (
    (re.compile(r"_(png|jpe?g|bmp|tiff?|webp)\.rf\.\w+$", re.IGNORECASE), ""),  # Roboflow
    (re.compile(r"^[0-9a-f]{8}-(?=.)"), ""),  # Label Studio
)
"""What other tools add to the stem of an uploaded image."""


@dataclass(frozen=True)
class ImagePlace:
    """The image of the workspace that a shape was drawn in, and in which pixels."""

    frame_index: int
    side: Side
    scale: tuple[float, float] = (1.0, 1.0)
    """Width and height of the image, relative to the one that was drawn in."""
    recorded: bool = False
    """Whether the pixels are those of the recorded image, which may have distortion."""
    is_either: bool = False
    """Whether it has a name that both a recorded image and semviz's rectified one have."""


@dataclass(frozen=True)
class NamedImages:
    """The recorded images of a drive of one's own, by the stem of their names, in small letters."""

    source: ImageFolder
    by_stem: Mapping[str, tuple[tuple[int, Side], ...]]

    @classmethod
    def of(cls, source: Dataset) -> "NamedImages | None":
        """Return the images of a dataset; None if its frames have the numbers of its files."""
        if not isinstance(source, ImageFolder):
            return None
        by_stem: dict[str, tuple[tuple[int, Side], ...]] = {}
        paths: tuple[tuple[Side, Mapping[int, Any]], ...]
        paths = (("left", source.left), ("right", source.right))
        for side, images in paths:
            for index, path in images.items():
                key = path.stem.lower()
                by_stem[key] = (*by_stem.get(key, ()), (index, side))
        return cls(source, by_stem)

    def find(self, name: str, side: Side | None) -> tuple[int, Side] | None:
        """Return frame and side of a recorded image by its name; None if there is none.

        Of several images with one stem, folders of the name, words in it, or ``side`` choose.
        """
        found = next(filter(None, (self.by_stem.get(stem, ()) for stem in stems(name))), ())
        folders = {part.lower() for part in _parts(name)[:-1]}
        for choose in (
            lambda row: bool(self._folders(row) & folders),
            lambda row: row[1] in sides_of(name),
            lambda row: row[1] == side,
        ):
            if len(found) > 1:
                found = tuple(filter(choose, found)) or found
        if len(found) > 1:
            raise SemvizError(
                f"image {quoted(name)}: {len(found)} images have this name; name its folder too, "
                "or say --side left or --side right"
            )
        return found[0] if found else None

    def _folders(self, row: tuple[int, Side]) -> set[str]:
        """Return names that tell images of one stem apart: folder and camera."""
        index, side = row
        path = (self.source.left if side == "left" else self.source.right)[index]
        names = {path.parent.name, self.source.camera_of.get(index, "")}
        return {name.lower() for name in names if name}


@dataclass(frozen=True)
class LabelImportContext:
    """The workspace and options that a file is checked against."""

    rules: Rules
    frames: Collection[int] | None = None
    """The existing frames; None accepts every number."""
    side: Side | None = None
    """Side of images whose names do not state it."""
    class_map: Mapping[str, str] = field(default_factory=dict)
    """Class name in the file -> semviz class name, or ``ignore``; ``*`` is every other name."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the labels of triangular signs mark in the workspace."""
    recorded: NamedImages | None = None
    """Recorded images, which files may name instead of frames."""
    pixels: PixelsOf | None = None
    """The images that were drawn in; None: as their names tell."""

    def class_id(self, name: object, parsed: ParsedLabels, where: str) -> int | None:
        """Return the class that the file calls ``name``; None if it is ignored or unknown.

        Unknown names are noted in ``parsed``, for ``refuse_unknown``.
        """
        if not isinstance(name, str):
            raise SemvizError(f"a class name is expected, not {quoted(name)}")
        classes = self.rules.classes
        mapped = self.class_map.get(name)
        if mapped is None and class_named(name, classes) is None:
            mapped = self.class_map.get(OTHERS)
        if mapped == IGNORE:
            parsed.drop(f"shapes of class {quoted(name)}: ignored, as asked")
            return None
        class_id = class_named(name if mapped is None else mapped, classes)
        if class_id is None and mapped is None and name.lower() in SIGNS_OF_ANY_SHAPE:
            parsed.assume(f"signs called {quoted(name)}, without a shape: rectangular")
            class_id = RECTANGULAR
        if class_id is None and mapped is not None:
            raise SemvizError(
                f"class {quoted(name)} is mapped to {quoted(mapped)}, which is not known; "
                f"say one of {self._class_names()}"
            )
        if class_id is None:
            parsed.unknown.setdefault(name, where)
        return class_id

    def refuse_unknown(self, parsed: ParsedLabels, path: object) -> None:
        """Raise SemvizError if the file has unknown classes: all of them, and how to map them."""
        if not parsed.unknown:
            return
        names = list(parsed.unknown)
        shown = [name if name.isprintable() and len(name) <= 50 else "NAME" for name in names]
        options = [f"--class-map {shlex.quote(f'{name}=CLASS')}" for name in dict.fromkeys(shown)]
        more = len(options) - _MOST_NAMED
        say = " ".join(options[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
        first, count = names[0], len(names)
        said = f"class {quoted(first)} is" if count == 1 else f"{count} classes are"
        rest = "" if count == 1 else f"; --class-map '{OTHERS}={IGNORE}' leaves out all others"
        with at(parsed.unknown[first] if count == 1 else path):
            raise SemvizError(
                f"{said} not known; say {say}, CLASS being one of {self._class_names()}{rest}"
            )

    def _class_names(self) -> str:
        return ", ".join(class_.name for class_ in self.rules.classes) + f", or {IGNORE}"

    def image(self, names: tuple[str, ...], size: tuple[object, object] | None) -> ImagePlace:
        """Return the image with the first of these names, the side from any, and its scale.

        A recorded image has its stem. Otherwise the frame is the longest number in the file name,
        the last of equally long ones. The side is a folder or word "left" or "right", or a folder
        of a KITTI camera (image_0, image_2: left; image_1, image_3: right). ``size`` is that of the
        image drawn in; None: as the workspace's.
        """
        found = None if self.recorded is None else self.recorded.find(names[0], self.side)
        is_ours = self.pixels != "recorded" and any(_OURS.search(_plain(name)) for name in names)
        if found is not None and not is_ours:
            return self.place(*found, size, recorded=self.pixels != "rectified")
        frame = self._frame_of(names[0])
        if self.frames is not None and frame not in self.frames:
            raise SemvizError(f"image {quoted(names[0])} is of frame {frame}, which is not there")
        sides = next(filter(None, map(sides_of, names)), None)
        if sides is not None and len(sides) > 1:
            raise SemvizError(f"image {quoted(names[0])} says both left and right")
        side = next(iter(sides)) if sides else self.side_or_refuse(f"image {quoted(names[0])}")
        place = self.place(frame, side, size, recorded=self.pixels == "recorded")
        is_either = found is not None and self.pixels is None and not self._is_same(place)
        return replace(place, is_either=is_either)

    def _is_same(self, place: ImagePlace) -> bool:
        """Whether the recorded image of a place is the rectified one."""
        index, side = place.frame_index, place.side
        return self.recorded is None or self.recorded.source.rectification(index, side).is_identity

    def _frame_of(self, name: str) -> int:
        if self.recorded is not None and not re.fullmatch(r"\d{6}", stems(name)[-1]):
            raise SemvizError(f"image {quoted(name)}: this drive has no image of that name")
        return _number_in(name)

    def side_or_refuse(self, what: str) -> Side:
        """Return the default side. Raise SemvizError if there are two cameras and no default."""
        if self.side is not None:
            return self.side
        if self.rules.rig is not None and self.rules.rig.right is None:
            return "left"
        raise SemvizError(
            f"{what} does not say whether it is left or right; name it like "
            "left/000012.png, or say --side left or --side right"
        )

    def place(
        self, frame: int, side: Side, size: tuple[object, object] | None, *, recorded: bool
    ) -> ImagePlace:
        """Return the place with its scale. Raise SemvizError for a size of another shape."""
        own = self._size(frame, side, recorded)
        if size is None:
            return ImagePlace(frame, side, recorded=recorded)
        width, height = (_checked_size(part, size) for part in size)
        if own is None or (width, height) == own:
            return ImagePlace(frame, side, recorded=recorded)
        scale = own[0] / width
        is_scaled = abs(width * own[1] - height * own[0]) <= 0.5 * (own[0] + own[1])  # rounded
        if not is_scaled or 1.0 / _LEAST_SCALE < scale < _LEAST_SCALE:
            which = "recorded " if recorded else ""
            other = "rectified" if recorded else "recorded"
            hint = f"; perhaps --pixels {other}" if self.recorded is not None else ""
            raise SemvizError(
                f"the image is {width}x{height}, but the {which}{side} images of this workspace "
                f"are {own[0]}x{own[1]}, and not the same ones scaled{hint}"
            )
        return ImagePlace(frame, side, (scale, own[1] / height), recorded)

    def _size(self, frame: int, side: Side, recorded: bool) -> tuple[int, int] | None:
        if recorded and self.recorded is not None:
            camera: Any = self.recorded.source.rectification(frame, side).original
        else:
            camera = self.rules.camera(side)
        return None if camera is None else (camera.width, camera.height)

    def add_observation(
        self, parsed: ParsedLabels, where: str, place: ImagePlace, class_id: int, shape: DrawnShape,
        **more: Any,
    ) -> None:  # fmt: skip
        """Add a shape to ``parsed``, as an observation or as dropped content."""
        marked = self._mark(parsed, class_id, shape)
        if marked is None:
            return
        self._note_assumed(place, parsed)
        anchor_px, *ends = self._labelled(marked, place)
        end_px = ends[0] if ends else None
        knows_peak = shape.is_peak_first or is_id(str(more.get("name")))  # semviz wrote it
        if not knows_peak and end_px is not None and anchor_px[1] > end_px[1]:
            anchor_px, end_px = end_px, anchor_px
            parsed.assume("poles drawn from their lower end: turned")
        drawn = ParsedObservation(
            where, place.frame_index, place.side, class_id, anchor_px, end_px, **more
        )
        is_region = shape.form in ("box", "polygon")
        observation = self._within(drawn, parsed) if place.recorded or is_region else drawn
        if observation is None:
            return
        if is_region and observation.outline is None:
            corners = self._labelled(list(shape.corners), place)
            observation = replace(observation, outline=outline_of(corners))
        self.rules.check(_observation(observation), class_id)
        if len(parsed.observations) >= MOST_ITEMS:
            raise SemvizError(f"more than {MOST_ITEMS} labels; split the file")
        parsed.observations.append(observation)

    def _within(self, row: ParsedObservation, parsed: ParsedLabels) -> ParsedObservation | None:
        """Return the part inside the image, where an end that is cut off is not known."""
        from semviz_annotation.assist.marked_image import Mark, clip_to_image

        camera = self.rules.camera(row.side)
        if camera is None:
            return row
        mark = Mark(row.anchor_px, row.end_px, row.anchor_known, row.end_known)
        part = clip_to_image(mark, mark.ends_px, camera)
        if not camera.contains(part.ends_px).all():
            parsed.drop("labels that are outside of the workspace's image")
            return None
        end_known = part.end_known if part.end_px is not None else row.end_known
        return replace(
            row,
            anchor_px=part.anchor_px,
            end_px=part.end_px,
            anchor_known=part.anchor_known,
            end_known=end_known,
        )

    def _mark(self, parsed: ParsedLabels, class_id: int, shape: DrawnShape) -> list[Pixel] | None:
        """Return peak and bottom, or the middle, in the image drawn in; None if it is neither."""
        element_class = self.rules.classes[class_id]
        if element_class.kind == "line":
            return _pole(parsed, element_class.name, shape)
        is_centroid = class_id == TRIANGULAR and self.triangle_center == "centroid"
        return _sign(parsed, element_class.name, shape, is_centroid)

    def _note_assumed(self, place: ImagePlace, parsed: ParsedLabels) -> None:
        """Count a label by what its place assumes."""
        if place.is_either:
            parsed.assume("images named like recorded and rectified ones: rectified (--pixels)")
        if place.scale != (1.0, 1.0):
            parsed.assume("labels of images of another size: scaled to that of the workspace")
        if self._is_rectified(place):
            parsed.assume("labels of recorded images: moved to the rectified ones")

    def _is_rectified(self, place: ImagePlace) -> bool:
        return place.recorded and self.recorded is not None and not self._is_same(place)

    def _labelled(self, drawn: Sequence[Pixel], place: ImagePlace) -> list[Pixel]:
        """Return points in pixels of the labelled image; unscaled ones keep all digits."""
        points = np.array(drawn)
        if place.scale != (1.0, 1.0):
            points = (points + 0.5) * place.scale - 0.5
        if self._is_rectified(place) and self.recorded is not None:
            source = self.recorded.source
            points = source.rectification(place.frame_index, place.side).to_rectified(points)
        return [(float(u), float(v)) for u, v in points]


def _pole(parsed: ParsedLabels, name: str, shape: DrawnShape) -> list[Pixel] | None:
    if shape.form == "line":
        if len(shape.points) > 2:
            parsed.drop("inner points of lines: a pole is its peak and its bottom")
        return [shape.points[0], shape.points[-1]]
    if shape.form == "points":
        parsed.drop(f"points of class {name}: a pole is a line from peak to bottom")
        return None
    what = f"{'boxes' if shape.form == 'box' else 'polygons'} of class {name}"
    ends = axis(shape.corners)
    if ends is None:
        parsed.drop(f"{what}: not slender, so they have no axis")
        return None
    parsed.assume(f"{what}: their axis is the pole; check its ends")
    return list(ends)


def _sign(
    parsed: ParsedLabels, name: str, shape: DrawnShape, is_centroid: bool
) -> list[Pixel] | None:
    if shape.form == "box":
        parsed.triangle_boxes += is_centroid
        return [shape.below_middle(1.0 / 6.0 if is_centroid else 0.0)]  # taken to stand upright
    if shape.form == "polygon":
        middle = centroid(shape.points)
        if middle is None:
            parsed.drop("flat polygons: they have no middle")
        return None if middle is None else [middle]
    if shape.form == "points" and len(shape.points) == 1:
        parsed.triangle_points += is_centroid
        return [shape.points[0]]
    parsed.drop(f"{shape.form} of class {name}: a sign is one point, a box or a polygon")
    return None


def _observation(parsed: ParsedObservation) -> Observation:
    return Observation(
        id="", element_id="", frame_index=parsed.frame_index, side=parsed.side,
        anchor_px=parsed.anchor_px, end_px=parsed.end_px,
        anchor_known=parsed.anchor_known, end_known=parsed.end_known,
    )  # fmt: skip


def _checked_size(part: object, size: tuple[object, object]) -> int:
    if not isinstance(part, int) or isinstance(part, bool) or not 0 < part < 2**31:
        raise SemvizError(f"an image of {quoted(size[0])} by {quoted(size[1])} pixels")
    return part


def stems(name: str) -> list[str]:
    """Return the stems that an image may be known by, in small letters; the plain one last."""
    stem = _parts(name)[-1]
    stem = stem.rpartition(".")[0] or stem
    found = [stem]
    for pattern, instead in _ADDED:
        found.append(pattern.sub(instead, found[-1]))
    return [text.lower() for text in dict.fromkeys(found)]


def _number_in(name: str) -> int:
    runs = next(filter(None, (re.findall(r"[0-9]+", stem) for stem in reversed(stems(name)))), [])
    digits = max(reversed(runs), key=len, default="")
    if not digits or len(digits) > 18 or int(digits) >= 2**31:
        raise SemvizError(
            f"image {quoted(name)} has no frame number in its name; name it like left/000012.png"
        )
    return int(digits)


def sides_of(name: str) -> set[Side]:
    """Return the sides that the folders and words of a name state."""
    words: set[str] = set()
    for part in _parts(name.lower()):
        words.update((part, *re.split(r"[^a-z]+", part)))
    return {_SIDES[word] for word in words if word in _SIDES}


def _plain(name: str) -> str:
    return name.replace("\\", "/")


def _parts(name: str) -> list[str]:
    return _plain(name).split("/")

"""Add stakes, posts of fences and signs of many kinds to a crop, with their labels.

Real roads have many that rendered streets lack: signs are small, worn, seen from behind or from a
side, and in the colours of other countries.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D, joined
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.research.training.crop_light import Floats, as_bytes, fractal
from semviz_core.research.training.crop_paint import (
    any_color,
    lay_over,
    pole_color,
    pole_light,
    unlike,
    window,
)
from semviz_core.research.training.detector_images import Crop
from semviz_core.simulation.drawing import Texture
from semviz_core.simulation.objects import SignLook
from semviz_core.simulation.sign_faces import face, worn_face

_LEAST_POST_PX, _MOST_NUMBER = 12.0, 200
"""Shortest post that is added; most elements of a crop, whose rows are bytes."""
_FOOT_PX = 4.0
"""A post that ends less above the lower edge of a front stands before it."""
_LEAST_LAMP_PX = 90.0
"""Least height of a post that may carry a lamp."""


def with_more_elements(crop: Crop, fronts: BoolArray, rng: np.random.Generator) -> Crop:
    """Return the crop, which must have masks, with posts and signs behind its own elements.

    No post stands on ``fronts`` (height, width): what is upright there is a bar of a window, as far
    as can be seen.
    """
    if rng.random() < 0.7:
        crop = _with_posts(crop, fronts, rng)
    return _with_signs(crop, fronts, rng) if rng.random() < 0.6 else crop


@dataclass(frozen=True)
class _Post:
    """A post to be added: an upright or leaning bar."""

    peak_px: FloatArray
    bottom_px: FloatArray
    width_px: float
    hidden_px: float
    """Length of its lower end that grass hides."""

    @classmethod
    def of(
        cls, peak_px: FloatArray, bottom_px: FloatArray, width_px: float, rng: np.random.Generator
    ) -> "_Post":
        """Return a post, some of whose lower end may be hidden."""
        length = float(np.linalg.norm(bottom_px - peak_px))
        hidden = rng.uniform(0.05, 0.4) * length if rng.random() < 0.35 else 0.0
        return cls(peak_px, bottom_px, max(1.2, width_px), hidden)

    def stands_on(self, mask: BoolArray) -> bool:
        """Whether what is seen ends inside a mask (height, width), and not just above its end."""
        span = self.bottom_px - self.peak_px
        seen = self.bottom_px - span * self.hidden_px / np.linalg.norm(span)
        u, v = np.round(seen + np.array((0.0, _FOOT_PX))).astype(int).tolist()
        height, width = mask.shape
        return 0 <= u < width and 0 <= v < height and bool(mask[v, u])


def _with_posts(crop: Crop, fronts: BoolArray, rng: np.random.Generator) -> Crop:
    """Return the crop with stakes, masts, or the posts of a fence, behind its own elements."""
    image, rows = crop.image.astype(np.float32), crop.rows.copy()
    posts = _fence(crop, rng) if rng.random() < 0.5 else _stakes(crop, rng)
    posts = [post for post in posts if not post.stands_on(fronts)]
    if not posts:
        return crop
    if rng.random() < 0.5 and len(posts) > 1:
        _rails(image, rows == 0, posts, rng)
    color = pole_color(_level_at(image, posts[-1]), rng)
    elements = crop.elements
    for post in posts:
        if len(elements) >= _MOST_NUMBER:
            break
        if np.ptp([post.peak_px[1], post.bottom_px[1]]) > _LEAST_LAMP_PX and rng.random() < 0.25:
            _arm(image, rows == 0, post, color, rng)
        shown = _paint_post(image, rows, post, len(elements) + 1, color, rng)
        if shown is not None:
            elements = joined(elements, shown)
    return replace(crop, image=as_bytes(image), elements=elements, rows=rows)


def _level_at(image: Floats, post: _Post) -> FloatArray:
    """Return the mean colour (3,) around the middle of a post."""
    height, width = image.shape[:2]
    u, v = np.clip((post.peak_px + post.bottom_px) / 2.0, 0.0, (width - 1.0, height - 1.0))
    around = image[max(0, int(v) - 8) : int(v) + 9, max(0, int(u) - 8) : int(u) + 9]
    return np.asarray(around.mean(axis=(0, 1)))


def _arm(
    image: Floats, behind: BoolArray, post: _Post, color: FloatArray, rng: np.random.Generator
) -> None:
    """Paint the bent arm of a street lamp, with its head, from the peak of a post on.

    It is no part of the pole.
    """
    length = float(np.linalg.norm(post.bottom_px - post.peak_px))
    reach, rise = rng.choice([-1, 1]) * rng.uniform(0.08, 0.3) * length, rng.uniform(0.0, 0.15)
    turn = np.linspace(0.0, np.pi / 2.0, 12)
    bend = np.stack([reach * (1.0 - np.cos(turn)), -rise * length * np.sin(turn)], axis=1)
    arm = np.round((post.peak_px + bend) * 16).astype(np.int32)
    cover: NDArray[np.uint8] = np.zeros(behind.shape, np.uint8)
    thick = max(1, round(0.6 * post.width_px))
    cv2.polylines(cover, [arm], False, 255, thick, cv2.LINE_AA, 4)
    head = np.round((post.peak_px + bend[-1] + [(0.0, 0.0), (0.35 * reach, 0.0)]) * 16)
    cv2.polylines(cover, [head.astype(np.int32)], False, 255, 2 * thick, cv2.LINE_AA, 4)
    alpha = (cover * behind / np.float32(255.0)).astype(np.float32)
    lay_over(image, alpha, color * rng.uniform(0.7, 1.3))


def _stakes(crop: Crop, rng: np.random.Generator) -> list[_Post]:
    """Return posts of any size that stand anywhere."""
    height, width = crop.rows.shape
    posts = []
    for _ in range(rng.integers(1, 5)):
        long = float(np.exp(rng.uniform(np.log(14.0), np.log(320.0))))
        bottom = np.array([rng.uniform(0, width), rng.uniform(0.35, 1.1) * height])
        thick = rng.uniform(0.012, 0.1) if long > _LEAST_LAMP_PX else rng.uniform(0.02, 0.2)
        posts.append(_post(bottom, long, thick, rng.normal(0.0, 0.05), rng))
    return posts


def _fence(crop: Crop, rng: np.random.Generator) -> list[_Post]:
    """Return a row of similar posts that recede towards a vanishing point."""
    height, width = crop.rows.shape
    horizon = np.array([rng.uniform(-0.5, 1.5) * width, rng.uniform(0.3, 0.6) * height])
    first = np.array([rng.uniform(0, width), horizon[1] + rng.uniform(30.0, 0.6 * height)])
    tall = rng.uniform(0.4, 1.6) * (first[1] - horizon[1])
    thick = float(np.exp(rng.uniform(np.log(0.025), np.log(0.22))))
    apart = rng.uniform(0.1, 0.6)
    posts = []
    for step in range(int(rng.integers(3, 10))):
        share = 1.0 / (1.0 + step * apart)
        bottom = horizon + share * (first - horizon)
        posts.append(_post(bottom, tall * share, thick, rng.normal(0.0, 0.06), rng))
    return posts[::-1]


def _post(
    bottom: FloatArray, long: float, thickness: float, lean: float, rng: np.random.Generator
) -> _Post:
    peak = bottom - long * np.array([np.sin(lean), np.cos(lean)])
    return _Post.of(peak, bottom, thickness * long, rng)


def _rails(image: Floats, behind: BoolArray, posts: list[_Post], rng: np.random.Generator) -> None:
    """Paint wires, or the bars of a fence, between neighbouring posts."""
    cover: NDArray[np.uint8] = np.zeros(behind.shape, np.uint8)
    for share in rng.uniform(0.05, 0.8, int(rng.integers(1, 4))):
        line = np.array([post.peak_px + share * (post.bottom_px - post.peak_px) for post in posts])
        points = [np.round(line * 16).astype(np.int32)]
        cv2.polylines(cover, points, False, 255, int(rng.integers(1, 3)), cv2.LINE_AA, 4)
    lay_over(image, cover * behind * np.float32(rng.uniform(0.3, 1.0) / 255.0), any_color(rng))


def _paint_post(
    image: Floats,
    rows: ByteImage,
    post: _Post,
    number: int,
    color: FloatArray,
    rng: np.random.Generator,
) -> Elements2D | None:
    """Paint a post where no element is, and number its pixels; None if too little is seen."""
    span, hidden = post.bottom_px - post.peak_px, post.hidden_px
    length, half = float(np.linalg.norm(span)), post.width_px / 2.0
    part, low = window(
        np.minimum(post.peak_px, post.bottom_px) - half,
        np.maximum(post.peak_px, post.bottom_px) + half,
    )
    free = rows[part] == 0
    if min(free.shape) < 2 or not free.any():
        return None
    v, u = np.indices(free.shape, np.float32)
    x, y = u + (low[0] - post.peak_px[0]), v + (low[1] - post.peak_px[1])
    along = (x * span[0] + y * span[1]) / length
    across = (x * span[1] - y * span[0]) / length
    end = np.full(free.shape, length - hidden)
    if hidden:
        end += 0.15 * hidden * fractal(rng, free.shape, 4.0)
    alpha = np.clip(half - np.abs(across) + 0.5, 0.0, 1.0) * np.clip(along + 0.5, 0.0, 1.0)
    alpha *= np.clip(end - along + 0.5, 0.0, 1.0) * free
    light = pole_light(rng, (across / half).astype(np.float32), (along / length).astype(np.float32))
    mine = alpha > 0.5
    line = _visible(mine, post.peak_px - low, span, length)
    if line is None:
        return None
    color = unlike(color, image[part][free].mean(axis=0), rng)
    lay_over(image[part], alpha.astype(np.float32), light[..., None] * color)
    rows[part][mine] = number
    first, last = line
    return Elements2D(
        anchor_px=(post.peak_px + span * first / length)[None],
        end_px=(post.peak_px + span * last / length)[None],
        class_id=np.array([POLE]),
        score=np.ones(1),
        sigma_px=np.ones((1, 2)),
        anchor_known=np.array([first < 1.0]),
        end_known=np.array([not hidden and last > length - 1.0]),
    )


def _visible(
    mine: BoolArray, start: FloatArray, span: FloatArray, length: float
) -> tuple[float, float] | None:
    """Return from where to where a post's axis is seen, in px; None if that is too short."""
    places = np.arange(0.0, length + 0.25, 0.5)
    points = np.round(start + places[:, None] * span / length).astype(int)
    inside = ((points >= 0) & (points < mine.shape[::-1])).all(axis=1)
    seen = np.zeros(len(places), bool)
    seen[inside] = mine[points[inside, 1], points[inside, 0]]
    shown = places[seen]
    if len(shown) < 2 or shown[-1] - shown[0] < _LEAST_POST_PX or seen.mean() < 0.3:
        return None
    return float(shown[0]), float(shown[-1])


_SIGNS: tuple[tuple[int, SignLook, tuple[float, ...]], ...] = (
    (TRIANGULAR, "new", (1.14,)), (TRIANGULAR, "faded", (1.14,)), (TRIANGULAR, "back", (1.14,)),
    (ROUNDED, "new", (1.0,)), (ROUNDED, "faded", (1.0,)), (ROUNDED, "back", (1.0,)),
    (RECTANGULAR, "new", (1.0, 0.67, 1.53)), (RECTANGULAR, "faded", (1.0, 0.67, 1.53)),
    (RECTANGULAR, "back", (0.67, 1.0, 1.5, 3.0)), (RECTANGULAR, "plank", (3.5, 5.5)),
    (RECTANGULAR, "street name", (3.0, 5.0)), (RECTANGULAR, "number", (1.2,)),
)  # fmt: skip
"""Class, look, and the widths over heights of signs that are added."""
_FACES = 15
_LEAST_SIGN_PX = 6.0
_LEAST_SHOWN = 0.7
"""Least share of an added sign that no element hides."""


@dataclass(frozen=True)
class _Plate:
    """A sign to be added, seen by the camera."""

    class_id: int
    texture: Texture
    middle_px: FloatArray
    corners_px: FloatArray
    """(4, 2) of its box, clockwise from the top left."""

    @property
    def height_px(self) -> float:
        return float(np.ptp(self.corners_px[:, 1]))


def _with_signs(crop: Crop, fronts: BoolArray, rng: np.random.Generator) -> Crop:
    """Return the crop with signs behind its own elements, most of them on posts of their own."""
    image, rows = crop.image.astype(np.float32), crop.rows.copy()
    elements = crop.elements
    for _ in range(rng.integers(1, 5)):
        if len(elements) >= _MOST_NUMBER:
            break
        plate = _plate(crop.rows.shape, rng)
        free = rows == 0
        post, number = _post_of(plate, rng), len(elements) + 1
        if rng.random() < 0.75 and not post.stands_on(fronts):
            shown = _paint_post(image, rows, post, number, any_color(rng) * 0.8, rng)
            if shown is not None:
                elements = joined(elements, shown)
        if _paint_plate(image, rows, plate, len(elements) + 1, free, rng):
            elements = joined(elements, _middle_of(plate))
    return replace(crop, image=as_bytes(image), elements=elements, rows=rows)


def _plate(shape: tuple[int, ...], rng: np.random.Generator) -> _Plate:
    """Draw a sign of any kind and size, turned to a side, anywhere above the crop's lowest part."""
    class_id, look, aspects = _SIGNS[rng.integers(len(_SIGNS))]
    aspect, number = float(rng.choice(aspects)), int(rng.integers(_FACES))
    new = look == "new"
    texture = face(class_id, number, aspect) if new else worn_face(look, class_id, number, aspect)
    if look == "plank" and rng.random() < 0.6:
        texture = _pointed(texture, bool(rng.random() < 0.5))
    height = np.exp(rng.uniform(np.log(8.0), np.log(70.0))) / max(1.0, aspect) ** 0.7
    half = np.array([aspect * height * rng.uniform(0.55, 1.0), height]) / 2.0
    nearer = 1.0 + rng.normal(0.0, 0.04)  # one side looks higher than the other
    tilt, roll = rng.normal(0.0, 0.04, 2)
    corners = np.array([(-1.0, -1.0), (1.0, -nearer), (1.0, nearer), (-1.0, 1.0)]) * half
    corners[:, 1] += corners[:, 0] * tilt
    corners[:, 0] -= corners[:, 1] * roll
    middle = rng.uniform((0.0, 0.0), (shape[1], 0.75 * shape[0]))
    return _Plate(class_id, texture, middle, corners + middle)


def _pointed(texture: Texture, to_the_left: bool) -> Texture:
    """Return a plank as an arrow; its box stays."""
    colors, opacity = texture.levels[0]
    height, width = opacity.shape
    tip = 0.5 * height
    outline = np.array([(0, 0), (width - tip, 0), (width, tip), (width - tip, height), (0, height)])
    if to_the_left:
        outline[:, 0] = width - outline[:, 0]
    arrow: NDArray[np.uint8] = np.zeros(opacity.shape, np.uint8)
    cv2.fillPoly(arrow, [np.round(outline - 0.5).astype(np.int32)], 1)
    return Texture.of(colors.astype(np.float32), opacity * arrow)


def _post_of(plate: _Plate, rng: np.random.Generator) -> _Post:
    """Return the post of a sign; its peak rises above the sign, as those of streets do."""
    height = plate.height_px
    above = height * rng.uniform(0.53, 0.85)
    span = height * np.exp(rng.uniform(np.log(1.6), np.log(7.0))) * np.array(
        [rng.normal(0.0, 0.02), 1.0]
    )  # fmt: skip
    peak = plate.middle_px - span * above / span[1]
    return _Post.of(peak, peak + span, height * rng.uniform(0.07, 0.18), rng)


def _paint_plate(
    image: Floats,
    rows: ByteImage,
    plate: _Plate,
    number: int,
    free: BoolArray,
    rng: np.random.Generator,
) -> bool:
    """Paint a sign where ``free``, and number its pixels; False if too little of it is seen."""
    low, high = plate.corners_px.min(axis=0), plate.corners_px.max(axis=0)
    if min(high - low) < _LEAST_SIGN_PX or (low < 0).any() or (high > free.shape[::-1]).any():
        return False
    part, corner = window(low, high)
    colors, opacity = plate.texture.level_for(*(high - low))
    height, width = opacity.shape
    of_texture = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32) - 0.5
    to_crop = cv2.getPerspectiveTransform(
        of_texture.astype(np.float32), (plate.corners_px - corner).astype(np.float32)
    )
    size = free[part].shape[::-1]
    cover = cv2.warpPerspective(opacity, to_crop, size)
    mine = (cover > 0.5) & free[part]
    if not mine.any() or mine.sum() < _LEAST_SHOWN * (cover > 0.5).sum():
        return False
    warped = cv2.warpPerspective(colors, to_crop, size, borderMode=cv2.BORDER_REPLICATE)
    if rng.random() < 0.25:  # other countries have other colours
        warped = warped[..., rng.permutation(3)]
    gain = np.exp(rng.uniform(-1.1, 0.3)) * np.exp(rng.normal(0.0, 0.08, 3))
    lay_over(image[part], (cover * free[part]).astype(np.float32), warped * gain.astype(np.float32))
    rows[part][mine] = number
    return True


def _middle_of(plate: _Plate) -> Elements2D:
    """Return a sign as an element: its middle is that of its box."""
    return Elements2D(
        anchor_px=plate.middle_px[None],
        end_px=np.full((1, 2), np.nan),
        class_id=np.array([plate.class_id]),
        score=np.ones(1),
        sigma_px=np.ones((1, 2)),
        anchor_known=np.array([True]),
        end_known=np.array([False]),
    )

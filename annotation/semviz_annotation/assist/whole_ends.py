"""Look for the ends of a pole beyond its mark, in the images of one moment together.

A pole that was labelled by half is seen whole in nearer frames. Its rows are followed past the mark
in two ways: along one line, with the colour of the whole mark; and piece by piece, with that of the
rows before, since light and background change along a pole. An end counts if it is clear in one
image, or if three of the four answers of two images agree. A bottom, which ends on the ground, is
clear even if it is faint where both answers of an image agree. Where an image does not show an end
by itself, it is as far beyond the mark as in the other one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.appearance import pole_width
from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_annotation.assist.snap import follow_pole
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_ends import grown_end

_ASIDE, _ASIDE_PX = 0.02, 1.0
"""A pole is followed past its end with a line that is off by so much per px, and at its end."""
_LEAST_PX, _LEAST_SHARE = 8.0, 0.15
"""A pole goes on beyond an end by so much, and by this share of its length, or not at all."""
_CLEAR_GAIN, _CLEAR_FALL = 15.0, -1.5
"""Log-odds of the rows beyond a clear end, and those of a row after the new end."""
_AGREED_GAIN = 8.0
"""Log-odds of the rows beyond an end about which answers agree: both about a bottom in an image, or
enough in all images."""
_VOTES = 3
"""Answers of all images that agree about an end."""
_SAME_PX, _SAME_SHARE = 3.0, 0.05
"""Answers agree up to this difference, or this share of what is beyond the mark."""


@dataclass(frozen=True)
class _Growth:
    """How far a pole goes on beyond one end of its mark in an image, as shares of the mark."""

    is_bottom: bool
    length_px: float
    along_line: float
    by_pieces: float
    gain: float
    """Log-odds of the rows beyond the mark."""
    fall: float
    """Mean log-odds of the rows just after."""

    @property
    def least(self) -> float:
        return max(_LEAST_PX / self.length_px, _LEAST_SHARE)

    @property
    def is_clear(self) -> bool:
        apart = abs(self.along_line - self.by_pieces)
        agree = self.is_bottom and apart <= _same(self.along_line, self.length_px)
        gain = _AGREED_GAIN if agree else _CLEAR_GAIN
        return self.along_line > self.least and self.gain > gain and self.fall < _CLEAR_FALL


def whole_marks(
    images: Sequence[MarkedImage], marks: Sequence[Mark], widths_px: Sequence[float]
) -> list[Mark]:
    """Return the marks of one pole in ``images``, with each end where the images show it to be.

    ``bench/half_poles.py`` measures what this finds of poles cut in half, and that whole ones stay.
    """
    ends = [mark.ends_px for mark in marks]
    known = [[mark.anchor_known, mark.end_known] for mark in marks]
    moved = [each.copy() for each in ends]
    for k in (0, 1):
        growths = [
            _growth(image, of, k, width)
            for image, of, width in zip(images, ends, widths_px, strict=True)
        ]
        is_seen = all(of[k] for of in known)
        for i, share in enumerate(_beyond(growths, is_seen)):
            place = ends[i][k] + share * (ends[i][k] - ends[i][1 - k])
            if share > 0.0 and images[i].view.camera.contains(place[None]).all():
                moved[i][k], known[i][k] = place, True
    return [
        Mark(pixel(peak), pixel(bottom), *of)
        for (peak, bottom), of in zip(moved, known, strict=True)
    ]


def _growth(image: MarkedImage, ends: FloatArray, k: int, width_px: float) -> _Growth:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    inner, end = ends[1 - k], ends[k]
    line = grown_end(image, inner, end, width_px, min(_ASIDE, _ASIDE_PX / length))
    pieces = np.linalg.norm(follow_pole(image, inner, end, pole_width(image, ends)) - end)
    return _Growth(
        k == 1, length, line.off_px / length, float(pieces) / length, line.gain, line.fall
    )


def _beyond(growths: Sequence[_Growth], is_seen: bool) -> list[float]:
    """Return how far the pole goes on in each image; 0 where it does not, as far as is known.

    Past an end that is hidden, what looks like the pole is often what hides it: only what is clear
    in the image itself counts there.
    """
    clear = [each for each in growths if each.is_clear]
    common = _agreed(growths) if is_seen else 0.0
    if is_seen and clear and not common:
        common = max(clear, key=lambda each: each.gain).along_line
    return [each.along_line if each.is_clear else common for each in growths]


def _agreed(growths: Sequence[_Growth]) -> float:
    """Return what enough answers agree about; 0 if there are not enough."""
    answers = np.array([[each.along_line, each.by_pieces] for each in growths]).ravel()
    least = max(each.least for each in growths)
    same = _same(answers, float(np.mean([each.length_px for each in growths])))
    agreeing = np.abs(answers - answers[:, None]) <= same[:, None]
    votes = np.where(answers > least, agreeing.sum(axis=1), 0)
    if votes.max() < _VOTES or sum(each.gain for each in growths) < _AGREED_GAIN:
        return 0.0
    return float(answers[agreeing[np.argmax(votes)]].mean())


def _same(answers: FloatArray | float, length_px: float) -> FloatArray:
    """Return up to which difference answers agree, as shares of a mark of this length."""
    return np.maximum(_SAME_PX / length_px, _SAME_SHARE * np.asarray(answers))

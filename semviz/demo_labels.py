"""The labels behind the demo's map: everything to be seen in each third frame, with one slip."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from semviz_annotation.assist.shot import Mark
from semviz_annotation.formats.plan import ImportLabels
from semviz_annotation.rows import LabelElement, Observation, derived_id
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street

AUTHOR = "demo"
EVERY = 3
SIGMA_PX = 0.3
SLIP_PX: dict[Side, float] = {"left": -36.0, "right": -34.5}
SIDES: tuple[Side, Side] = ("left", "right")


def demo_labels(street: Street, slipped: int, frame: int) -> ImportLabels:
    """Each element has its number in the street's true map.

    The pole ``slipped`` is labelled in ``frame`` alone, and there beside where it stands, by
    ``SLIP_PX`` along the row: no other label contradicts.
    """
    frames = range(0, len(street.frames), EVERY)
    drawn = [one for index in frames for side in SIDES for one in _drawn(street, index, side)]
    name = _name(slipped)
    rows = [one for one in drawn if one.element_id != name]
    rows += [_slip(one) for one in drawn if (one.element_id, one.frame_index) == (name, frame)]
    seen = {one.element_id for one in rows}
    mapped = street.truth_map.elements
    classes = zip(mapped.id.tolist(), mapped.class_id.tolist(), strict=True)
    elements = (LabelElement(_name(number), number, class_id) for number, class_id in classes)
    return ImportLabels(tuple(one for one in elements if one.id in seen), tuple(rows))


def _drawn(street: Street, index: int, side: Side) -> Iterator[Observation]:
    """Where a careful person sees things: each end off by ``SIGMA_PX`` in each direction."""
    rng = np.random.default_rng([street.seed, index, side == "right"])
    seen, numbers = street.labels(index, side)
    camera = street.rig.left
    corner = np.array([camera.width - 1.0, camera.height - 1.0])
    off_px = rng.normal(0.0, SIGMA_PX, (2, len(seen), 2))
    drawn = replace(
        seen,
        anchor_px=(seen.anchor_px + off_px[0]).clip(0.0, corner),
        end_px=(seen.end_px + off_px[1]).clip(0.0, corner),
    )
    for row, number in enumerate(numbers.tolist()):
        id = derived_id(f"observation {index} {side} {number}")
        yield Mark.seen(drawn, row).at(index, side, id, _name(number))


def _slip(row: Observation) -> Observation:
    (u, v), by = row.anchor_px, SLIP_PX[row.side]
    end = None if row.end_px is None else (row.end_px[0] + by, row.end_px[1])
    return replace(row, anchor_px=(u + by, v), end_px=end)


def _name(number: int) -> str:
    """UUID of the label element."""
    return derived_id(f"element {number}")

"""Labels to write to files and read back, for tests of formats."""

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.rows import Rules, derived_id
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.pose import Pose

CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]))
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.5, 0.0, 0.0])))
RULES = Rules(rig=RIG)
FRAMES = range(20)


def pole(
    number: int, frame: int, side: str, *points: tuple[float, float], known: bool = True
) -> Observation:
    """An observation of element ``number``: a pole with two points, a sign with one."""
    return Observation(
        id=derived_id(f"observation {number} {frame} {side}"),
        element_id=derived_id(f"element {number}"),
        frame_index=frame,
        side=side,  # type: ignore[arg-type]
        anchor_px=points[0],
        end_px=points[1] if len(points) == 2 else None,
        anchor_known=True,
        end_known=known and len(points) == 2,
    )


def labels_of(*rows: Observation, sign_class: int = 3) -> Labels:
    """Those observations with elements of class pole, or ``sign_class`` where they have no end."""
    elements: dict[str, LabelElement] = {}
    for row in rows:
        number = len(elements) + 1
        class_id = 0 if row.end_px is not None else sign_class
        elements.setdefault(row.element_id, LabelElement(row.element_id, number, class_id))
    return Labels.from_rows([*elements.values(), *rows])


def street() -> Labels:
    """Two poles, one of them in two frames and both images, its bottom hidden once; two signs."""
    return labels_of(
        pole(1, 3, "left", (100.1, 20.2), (101.3, 300.7), known=False),
        pole(1, 3, "right", (90.1, 20.3), (91.2, 300.4)),
        pole(1, 4, "left", (80.0, 10.0), (81.0, 310.0)),
        pole(2, 4, "right", (600.0, 5.0), (601.5, 100.25)),
        pole(3, 4, "right", (333.333, 44.4)),
        pole(4, 7, "left", (0.1, 0.2)),
    )


def store_of(labels: Labels, folder: Path) -> LabelStore:
    """A label file in the new ``folder`` that holds ``labels``."""
    folder.mkdir()
    store = LabelStore.open(folder / "labels.db", rig=RIG)
    if labels.elements:
        edit = ImportLabels(tuple(labels.elements.values()), tuple(labels.observations.values()))
        store.apply(edit, "ann")
    return store


def said(labels: Labels) -> set[tuple[Any, ...]]:
    """All that observations say, but their own ids."""
    return {
        (labels.element(row.element_id), row.frame_index, row.side, row.anchor_px, row.end_px,
         row.anchor_known, row.end_known)
        for row in labels.observations.values()
    }  # fmt: skip


@st.composite
def any_labels(draw: st.DrawFn) -> Labels:
    """Labels of any shape that the rules allow, in four frames of both images."""
    pixel = st.tuples(st.floats(-0.5, 639.5), st.floats(-0.5, 479.5))
    numbers = draw(st.lists(st.integers(1, 999), max_size=5, unique=True))
    rows: list[LabelElement | Observation] = []
    for number in numbers:
        drawn = draw(st.sampled_from(list(DEFAULT_CLASSES)))
        element = LabelElement(derived_id(f"element {number}"), number, drawn.id)
        rows.append(element)
        images = st.tuples(st.integers(0, 3), st.sampled_from(["left", "right"]))
        for frame, side in draw(st.lists(images, min_size=1, max_size=6, unique=True)):
            anchor_px, end_px = draw(pixel), draw(pixel) if drawn.kind == "line" else None
            if end_px is not None and np.hypot(*np.subtract(anchor_px, end_px)) < 0.5:
                end_px = (anchor_px[0], anchor_px[1] - 9.0 if anchor_px[1] > 99 else 100.0)
            rows.append(
                Observation(
                    id=derived_id(f"observation {number} {frame} {side}"), element_id=element.id,
                    frame_index=frame, side=side, anchor_px=anchor_px, end_px=end_px,
                    anchor_known=draw(st.booleans()),
                    end_known=end_px is not None and draw(st.booleans()),
                )
            )  # fmt: skip
    return Labels.from_rows(rows)

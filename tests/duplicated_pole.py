"""A labelled street with one pole that was labelled as two, and maps with decisions about it."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.rows import derived_id
from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, Provenance, SemanticMap

FRAMES = 6
TWICE = range(3, FRAMES)
"""In these frames the planted pole is another label element."""
SIGMA_PX = 0.3


def street(path: Path) -> Workspace:
    """Everything in sight is labelled with care; one pole is numbered 1 in the first frames and
    2 in those of ``TWICE``."""
    workspace = Workspace.create_street(path, 7, range(FRAMES))
    rng = np.random.default_rng(0)
    elements: dict[str, LabelElement] = {}
    rows: list[Observation] = []
    pole = _seen_always(workspace)
    for index in range(FRAMES):
        for side in ("left", "right"):
            seen, ids = workspace.street.labels(index, side)
            for row, thing in enumerate(ids.tolist()):
                is_twin = thing == pole and index in TWICE
                number = (2 if is_twin else 1) if thing == pole else 10 + thing
                element = LabelElement(element_id(number), number, int(seen.class_id[row]))
                elements.setdefault(element.id, element)
                ends = np.clip(
                    np.stack([seen.anchor_px[row], seen.end_px[row]])
                    + rng.normal(0.0, SIGMA_PX, (2, 2)),
                    0.0,
                    [1240.0, 375.0],
                ).tolist()
                is_line = bool(seen.is_line[row])
                rows.append(
                    Observation(
                        id=derived_id(f"{thing} {index} {side}"),
                        element_id=element.id,
                        frame_index=index,
                        side=side,
                        anchor_px=tuple(ends[0]),
                        end_px=tuple(ends[1]) if is_line else None,
                        anchor_known=bool(seen.anchor_known[row]),
                        end_known=is_line and bool(seen.end_known[row]),
                    )
                )
    with workspace.open_labels() as store:
        store.apply(ImportLabels(tuple(elements.values()), tuple(rows)), "planter")
    return workspace


def _seen_always(workspace: Workspace) -> int:
    """The nearest pole that both images of all frames show."""
    truth = workspace.street.truth_map.elements
    poles = set(truth.id[truth.class_id == POLE].tolist())
    for index in range(FRAMES):
        for side in ("left", "right"):
            poles &= set(workspace.street.labels(index, side)[1].tolist())
    return min(poles, key=lambda pole: float(truth.anchor_m[truth.id == pole][0, 0]))


def element_id(number: int) -> str:
    return derived_id(f"planted element {number}")


def planted_map(workspace: Workspace, labels: Labels, decisions: Iterable[Decision]) -> SemanticMap:
    """The two planted elements as one, which leans by 37 deg, and ``decisions``."""
    elements = Elements3D.from_ends([1], [[20.0, 4.0, 4.0]], [[23.0, 4.0, 0.0]], [POLE])
    both = Provenance((element_id(1), element_id(2)), tuple(sorted(labels.observations)))
    made = SemanticMap(elements, workspace.source.map_frame, provenance=(both,))
    return replace(made, decisions=tuple(decisions), operation=labels.operation)


def merge() -> Decision:
    """Of the planted pole."""
    ids = (element_id(1), element_id(2))
    evidence = {"distance_m": 0.123, "chi2_together": 31.0, "off_m": float("nan")}
    return Decision("merge", ids, (1, 2), "machine", "they fit one place", evidence)


def left_out(labels: Labels) -> Decision:
    """Of another element."""
    kept = max(labels.elements.values(), key=lambda element: element.number)
    return Decision("leave out", (kept.id,), (kept.number,), "machine", "its views disagree")

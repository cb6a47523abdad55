"""Maps from labels."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.build_map import BuildOptions, build_map
from semviz_annotation.labels import Labels, Observation
from semviz_core.errors import SemvizError
from semviz_core.map_file import load_map, save_map
from semviz_core.semantic_map import MapFrame


def split_by_frame(labels: Labels) -> Labels:
    """The same labels without identity over frames: each frame has elements of its own."""
    from semviz_annotation.labels import LabelElement, new_id

    rows: list = []
    number = labels.next_number
    for index in labels.frames:
        new = {}
        for row in labels.in_frame(index):
            if row.element_id not in new:
                old = labels.element(row.element_id)
                new[row.element_id] = LabelElement(new_id(), number, old.class_id)
                number += 1
            rows.append(replace(row, element_id=new[row.element_id].id))
        rows += new.values()
    return Labels.from_rows(rows)


def test_exact_labels_give_the_exact_map(world):
    labels = world.labels()
    semantic_map, report = build_map(labels, world)
    assert list(semantic_map.elements.id) == [3, 4, 7, 9]
    for row, number in enumerate(semantic_map.elements.id):
        kind, anchor, end = world.things[number]
        assert semantic_map.elements.class_id[row] == kind
        assert np.allclose(semantic_map.elements.anchor_m[row], anchor, atol=1e-6)
        if end is not None:
            assert np.allclose(semantic_map.elements.end_m[row], end, atol=1e-6)
        else:
            assert np.isnan(semantic_map.elements.end_m[row]).all()
    assert report.rejected == () and report.merged == ()
    assert semantic_map.frame == MapFrame("world")
    assert semantic_map.trajectory_m.shape == (world.count, 3)
    print(report, semantic_map.made_by)

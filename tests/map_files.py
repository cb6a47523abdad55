"""Maps to write to files and read back, for tests of map formats."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semviz_annotation.map_formats.conversion import MapImportContext
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, MapFrame, Provenance, SemanticMap

FRAME = MapFrame("town")
READING = MapImportContext(FRAME)
KARLSRUHE = Georeference(49.01, 8.42, 115.0, 33.0)
ROAD = np.array([[0.0, 0.0, 1.6], [5.0, 0.5, 1.6], [10.0, 2.0, 1.7]])


def small_map() -> SemanticMap:
    """Two poles, one with a bottom that nobody saw, and a sign of each shape beside a road."""
    n = np.nan
    rng = np.random.default_rng(1)
    factor = rng.normal(0.0, 0.1, (5, 6, 6))
    covariance = factor @ factor.transpose(0, 2, 1)
    covariance[2:, 3:] = covariance[2:, :, 3:] = 0.0
    elements = Elements3D(
        id=np.array([4, 7, 9, 12, 1_000_004]),
        anchor_m=np.array([[4.0, 3.0, 6.1], [8.0, -4.0, 5.0], [9.0, 4.0, 2.5], [3.0, -3.0, 2.2],
                           [6.0, 5.0, 2.0]]),
        end_m=np.array([[4.1, 3.0, 0.1], [8.0, -4.2, 0.9], [n, n, n], [n, n, n], [n, n, n]]),
        class_id=np.array([POLE, POLE, TRIANGULAR, RECTANGULAR, ROUNDED]),
        covariance_m2=covariance,
        anchor_known=np.array([True, False, True, True, True]),
        end_known=np.array([True, False, False, False, False]),
    )  # fmt: skip
    provenance = tuple(Provenance((f"label {k}",), (f"seen {k}", f"again {k}")) for k in range(5))
    decision = Decision("merge", ("label 0", "label 1"), (4, 5), "machine", "They are one.")
    return SemanticMap(
        elements, FRAME, trajectory_m=ROAD, provenance=provenance, decisions=(decision,)
    )


@st.composite
def any_map(draw: st.DrawFn) -> SemanticMap:
    """One to six elements of any kind within a few kilometres."""
    count = draw(st.integers(1, 6))
    metres = st.floats(-5000.0, 5000.0)
    is_line = draw(hnp.arrays(np.bool_, count))
    end = draw(hnp.arrays(np.float64, (count, 3), elements=metres))
    end[~is_line] = np.nan
    factor = draw(hnp.arrays(np.float64, (count, 6, 6), elements=st.floats(-1.0, 1.0)))
    covariance = factor @ factor.transpose(0, 2, 1)
    covariance[~is_line, 3:] = covariance[~is_line, :, 3:] = 0.0
    classes = st.sampled_from([TRIANGULAR, RECTANGULAR, ROUNDED])
    class_id = np.where(is_line, POLE, draw(hnp.arrays(np.int64, count, elements=classes)))
    ids = draw(st.lists(st.integers(0, 2**50), min_size=count, max_size=count, unique=True))
    elements = Elements3D(
        id=np.array(ids),
        anchor_m=draw(hnp.arrays(np.float64, (count, 3), elements=metres)),
        end_m=end,
        class_id=class_id,
        covariance_m2=covariance,
        anchor_known=draw(hnp.arrays(np.bool_, count)),
        end_known=draw(hnp.arrays(np.bool_, count)) & is_line,
    )
    return SemanticMap(elements, FRAME)


@st.composite
def georeferences(draw: st.DrawFn) -> Georeference:
    """Anywhere on Earth but within some kilometres of the poles."""
    return Georeference(
        draw(st.floats(-89.9, 89.9)), draw(st.floats(-180.0, 180.0)),
        draw(st.floats(-400.0, 8000.0)), draw(st.floats(0.0, 360.0)),
    )  # fmt: skip


def assert_near(semantic_map: SemanticMap, other: SemanticMap, metres: float) -> None:
    """Ids and classes are equal, places nearly."""
    np.testing.assert_array_equal(semantic_map.elements.id, other.elements.id)
    np.testing.assert_array_equal(semantic_map.elements.class_id, other.elements.class_id)
    np.testing.assert_allclose(
        semantic_map.elements.anchor_m, other.elements.anchor_m, atol=metres, rtol=0
    )
    np.testing.assert_allclose(
        semantic_map.elements.end_m, other.elements.end_m, atol=metres, rtol=0
    )


def feature(kind: str, coordinates: Any, class_: str = "pole", **properties: Any) -> dict[str, Any]:
    """A feature of GeoJSON, as others write it."""
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": {"class": class_, **properties},
    }

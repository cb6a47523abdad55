"""The table of mapping accuracy, against an example worked by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest

from semviz_annotation.labels.labels import LabelElement, Labels, Observation, new_id
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.check import Gate, mapping_accuracy
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError


def observation(element: LabelElement, frame: int, anchor, end=None) -> Observation:
    return Observation(new_id(), element.id, frame, "left", anchor, end, True, end is not None)


@pytest.fixture
def example(world):
    """One sign and one pole 10 m ahead of frame 0, at pixels that can be worked out by hand.

    With f = 720, (cx, cy) = (610, 180) and the camera 1.65 m high looking along x, the point
    (10, y, z) is at u = 610 - 72 y, v = 180 - 72 (z - 1.65). So the sign is at (610, 108), and the
    pole runs from (250, 36) to (250, 252). In frame 1, 2 m ahead: u = 610 - 90 y, so the sign
    is at (610, 90).
    """
    sign, pole = LabelElement(new_id(), 1, 1), LabelElement(new_id(), 2, 0)
    stray = LabelElement(new_id(), 3, 2)
    semantic_map = SemanticMap(
        elements=Elements3D.from_ends(
            id=[1, 2],
            anchor_m=[[10.0, 0.0, 2.65], [10.0, 5.0, 3.65]],
            end_m=[[np.nan] * 3, [10.0, 5.0, 0.65]],
            class_id=[1, 0],
        ),
        frame=world.map_frame,
        provenance=(Provenance((sign.id,)), Provenance((pole.id,))),
    )
    labels = Labels.from_rows(
        [
            sign,
            pole,
            stray,
            observation(sign, 0, (607.0, 112.0)),  # error (+3, -4)
            observation(sign, 1, (609.0, 90.0)),  # error (+1, 0)
            observation(pole, 0, (250.0 - 8.0, 40.0), (250.0 + 6.0, 200.0)),
            observation(stray, 0, (5.0, 5.0)),
        ]
    )
    return semantic_map, labels


def test_hand_worked_example(example, world):
    semantic_map, labels = example
    result = mapping_accuracy(semantic_map, labels, world)
    sign = result.classes["triangular sign"]
    assert sign.observations == 2
    assert sign.rmse_px == pytest.approx(np.sqrt((25 + 1) / 2), abs=1e-9)
    assert (sign.lateral_me_px, sign.lateral_sde_px) == pytest.approx((2.0, 1.0), abs=1e-9)
    assert sign.lateral_rmse_px == pytest.approx(np.sqrt(5.0), abs=1e-9)
    assert sign.longitudinal_me_px == pytest.approx(-2.0, abs=1e-9)
    assert sign.longitudinal_sde_px == pytest.approx(2.0, abs=1e-9)
    assert sign.angular_me_deg is None
    pole = result.classes["pole"]
    # The projection is upright at u = 250: 8 px right of the labelled peak, 6 px left of the
    # bottom. The label runs down and 14 px to the right in 160, so the projection is turned
    # from it by atan(14 / 160), from right (u) towards down (v).
    assert pole.lateral_me_px == pytest.approx(1.0, abs=1e-9)
    assert pole.lateral_sde_px == pytest.approx(7.0, abs=1e-9)
    assert pole.lateral_rmse_px == pytest.approx(np.sqrt(50.0), abs=1e-9)
    assert pole.angular_me_deg == pytest.approx(np.rad2deg(np.arctan2(14, 160)), abs=1e-9)
    assert pole.angular_sde_deg == pytest.approx(0.0, abs=1e-9)
    assert pole.angular_rmse_deg == pytest.approx(np.rad2deg(np.arctan2(14, 160)), abs=1e-9)
    assert (pole.rmse_px, pole.longitudinal_me_px, pole.observations) == (None, None, 1)
    assert (result.elements, result.unmapped) == (2, 1)
    assert result.classes["rounded sign"].observations == 0
    assert result.classes["rounded sign"].rmse_px is None


def test_the_gate_is_of_rmse_and_angle(example, world):
    """The sign's RMSE is sqrt(13) = 3.606 px, the pole's lateral RMSE sqrt(50) = 7.071 px and its
    angle atan(14 / 160) = 5.001 deg: each limit fails just above its figure, not just below."""
    result = mapping_accuracy(*example, world)
    assert Gate(max_rmse_px=7.08, max_angle_deg=5.01).failures(result) == ()
    assert Gate(max_rmse_px=7.07, max_angle_deg=5.01).failures(result) == (
        "pole: lateral RMSE 7.071 px, not below 7.07",
    )
    assert Gate(max_rmse_px=7.08, max_angle_deg=5.0).failures(result) == (
        "pole: angular RMSE 5.001 deg, not below 5",
    )
    strict = Gate().failures(result)
    assert [line.partition(":")[0] for line in strict] == ["pole", "triangular sign"]
    assert strict[1] == "triangular sign: RMSE 3.606 px, not below 1"
    nothing = Gate().failures(mapping_accuracy(*example, world, [4]))
    assert nothing == ("nothing was measured: no label is of an element of the map",)


def test_frames_are_chosen(example, world):
    semantic_map, labels = example
    sign = mapping_accuracy(semantic_map, labels, world, [1]).classes["triangular sign"]
    assert (sign.observations, sign.lateral_me_px) == (1, pytest.approx(1.0))


def test_dictionary_and_table(example, world):
    result = mapping_accuracy(*example, world)
    data = json.loads(json.dumps(result.as_dict()))
    assert set(data) >= {"classes", "elements"}
    assert set(data["classes"]["pole"]) >= {
        "rmse_px",
        "lateral_me_px",
        "lateral_sde_px",
        "longitudinal_me_px",
        "longitudinal_sde_px",
        "angular_me_deg",
        "angular_sde_deg",
        "observations",
    }
    text = result.as_text()
    assert "triangular sign" in text.splitlines()[0]
    assert text.splitlines()[1].split()[:4] == ["RMSE", "(px)", "-", "3.606"]
    assert len({len(line) for line in text.splitlines()[:-1]}) == 1


def test_errors_of_a_built_map_are_those_of_the_labels(world):
    exact = world.labels()
    built, _ = build_map(exact, world)
    zero = mapping_accuracy(built, exact, world).classes
    assert zero["triangular sign"].rmse_px < 1e-6
    assert abs(zero["pole"].angular_me_deg) < 1e-6
    noisy = world.labels(sigma_px=1.0, seed=3)
    built, _ = build_map(noisy, world)
    rms = mapping_accuracy(built, noisy, world).classes["triangular sign"].rmse_px
    assert 0.6 < rms < 2.0


def test_what_does_not_fit_is_refused(example, world):
    semantic_map, labels = example
    with pytest.raises(SemvizError, match="the map is of 'moon', the images of 'world'"):
        mapping_accuracy(replace(semantic_map, frame=MapFrame("moon")), labels, world)
    with pytest.raises(SemvizError, match="not made from labels"):
        mapping_accuracy(replace(semantic_map, provenance=()), labels, world)
    with pytest.raises(SemvizError, match="frame 1 is labelled but not in this sequence"):
        mapping_accuracy(semantic_map, labels, replace(world, count=1))

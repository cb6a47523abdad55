"""Classes: unique in id, name and letter; what an element is called."""

from dataclasses import replace

import pytest

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ROUNDED, ClassSet
from semviz_core.common.errors import SemvizError


def test_the_four_classes_of_the_paper_keep_their_ids() -> None:
    assert [(class_.id, class_.name, class_.kind) for class_ in DEFAULT_CLASSES] == [
        (0, "pole", "line"),
        (1, "triangular sign", "point"),
        (2, "rectangular sign", "point"),
        (3, "rounded sign", "point"),
    ]


@pytest.mark.parametrize("field", ["shape", "color", "color_light"])
def test_classes_can_be_told_apart(field: str) -> None:
    assert len({getattr(class_, field) for class_ in DEFAULT_CLASSES}) == len(DEFAULT_CLASSES)


def test_names_for_people() -> None:
    assert DEFAULT_CLASSES.element_name(POLE, 4) == "P-04"
    assert DEFAULT_CLASSES.element_name(ROUNDED, 123) == "O-123"


def test_classes_are_found_by_id() -> None:
    assert DEFAULT_CLASSES[POLE].name == "pole"
    assert POLE in DEFAULT_CLASSES
    assert 99 not in DEFAULT_CLASSES
    with pytest.raises(SemvizError, match=r"unknown class 99; known are 0 \(pole\)"):
        DEFAULT_CLASSES[99]


@pytest.mark.parametrize("field", ["id", "name", "letter"])
def test_two_classes_cannot_share(field: str) -> None:
    pole, triangle = DEFAULT_CLASSES[0], DEFAULT_CLASSES[1]
    twin = replace(triangle, **{field: getattr(pole, field)})
    with pytest.raises(SemvizError, match=f"share the same {field}"):
        ClassSet((pole, twin))

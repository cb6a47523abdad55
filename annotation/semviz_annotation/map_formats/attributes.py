"""Attributes of map elements in files: what is read, and what a format cannot hold."""

import re
from collections.abc import Mapping

from semviz_annotation.label_formats.reading import quoted
from semviz_annotation.labels.rows import MAX_VALUE_LENGTH, NAME_PATTERN
from semviz_annotation.map_formats.conversion import ConversionTally
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError


def drop_attributes(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count the dropped attributes of elements."""
    count = sum(map(len, semantic_map.attributes.values()))
    tally.drop("attributes: the format has no place for them", count)


def parsed_attributes(values: Mapping[str, object]) -> dict[str, str]:
    """Return attributes of a file. Raise SemvizError if a name or a value is none."""
    for name, value in values.items():
        if not re.fullmatch(NAME_PATTERN, name):
            raise SemvizError(f"{quoted(name)} is no name of an attribute")
        if not isinstance(value, str) or not 0 < len(value) <= MAX_VALUE_LENGTH:
            raise SemvizError(f"{quoted(value)} is no text of 1 to {MAX_VALUE_LENGTH} characters")
    return {name: str(value) for name, value in sorted(values.items())}

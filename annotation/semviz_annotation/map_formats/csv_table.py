"""CSV in and out: one row per element, metres in the map frame, all digits."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from semviz_annotation.label_formats.reading import MOST_JSON_BYTES, at, number, quoted, read_bytes
from semviz_annotation.map_formats import conversion
from semviz_annotation.map_formats.attributes import parsed_attributes
from semviz_annotation.map_formats.conversion import LOG_ODDS, ConversionTally, drop_history
from semviz_core.base.classes import OLDER_CENTER, parse_triangle_center
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import cell_text, csv_text, replacing

ANCHOR = ("anchor_x_m", "anchor_y_m", "anchor_z_m")
END = ("end_x_m", "end_y_m", "end_z_m")
SIGMA = tuple(f"sigma_{name}" for name in (*ANCHOR, *END))
KNOWN = ("anchor_known", "end_known")
CENTER = "triangle_center"
ATTRIBUTE = "attribute:"
"""Prefix of a column; the name of the attribute follows."""
COLUMNS = ("id", "class", "frame", *ANCHOR, *END, *SIGMA, *KNOWN, CENTER)
_NEEDED = ("class", *ANCHOR)
_FLAGS = {"true": True, "false": False, "1": True, "0": False, "": True}


def write_csv(semantic_map: SemanticMap, path: Path) -> ConversionTally:
    """Write one row per element; the end of a sign is empty."""
    elements = semantic_map.elements
    sigmas = np.sqrt(np.diagonal(elements.covariance_m2, axis1=1, axis2=2))
    log_odds = [entry.log_odds for entry in semantic_map.provenance]
    has_odds = any(odds is not None for odds in log_odds)
    names = sorted({name for values in semantic_map.attributes.values() for name in values})
    header = [*COLUMNS, *([LOG_ODDS] if has_odds else []), *(ATTRIBUTE + name for name in names)]
    rows: list[Sequence[object]] = [header]
    for row, is_line in enumerate(elements.is_line.tolist()):
        name = semantic_map.classes[int(elements.class_id[row])].name
        end, end_sigmas = elements.end_m[row].tolist(), sigmas[row, 3:].tolist()
        rows.append(
            [int(elements.id[row]), name, semantic_map.frame.name, *elements.anchor_m[row].tolist(),
             *(end if is_line else [""] * 3), *sigmas[row, :3].tolist(),
             *(end_sigmas if is_line else [""] * 3),
             *(str(bool(getattr(elements, flag)[row])).lower() for flag in KNOWN),
             semantic_map.triangle_center,
             *(["" if log_odds[row] is None else log_odds[row]] if has_odds else []),
             *(semantic_map.attributes.get(int(elements.id[row]), {}).get(name, "")
               for name in names)]
        )  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(csv_text(rows), encoding="utf-8", newline="")
    tally = ConversionTally()
    correlated = elements.covariance_m2 * ~np.eye(6, dtype=bool)
    tally.drop("correlations of coordinates", int(correlated.any(axis=(1, 2)).sum()))
    drop_history(semantic_map, tally)
    tally.drop("labels and observations that elements come from", len(semantic_map.provenance))
    tally.drop("where the map's origin is on Earth", int(semantic_map.frame.origin is not None))
    return tally


def read_csv(path: Path, context: conversion.MapImportContext) -> conversion.ParsedMap:
    """Return the elements of a table with at least the columns ``class`` and ``anchor_*_m``."""
    try:
        text = read_bytes(path, MOST_JSON_BYTES).decode("utf-8-sig")
        rows = csv.DictReader(io.StringIO(text), restkey="more", strict=True)
        header = rows.fieldnames or []
        missing = [name for name in _NEEDED if name not in header]
        if missing:
            other = next((sign for sign in ";\t" if sign in ",".join(header)), None)
            why = f"; columns are separated by {other!r}, write ','" if other else ""
            names = quoted(",".join(header))
            raise SemvizError(f"no column {missing[0]!r}; the header is {names}{why}")
        parsed = conversion.ParsedMap(georeference=context.anchor)
        centers = set()
        for row in rows:
            with at(f"{path}, line {rows.line_num}"):
                _read_row(row, parsed, context)
                centers.add(parse_triangle_center(row.get(CENTER) or None))
        if len(centers) > 1:
            raise SemvizError(f"box and centroid in one map; give one {CENTER} in all rows")
        parsed.triangle_center = next(iter(centers), OLDER_CENTER)
    except (UnicodeDecodeError, csv.Error) as error:
        raise SemvizError(f"not a CSV table ({error})") from None
    for name in header:
        if name not in COLUMNS and not name.startswith(ATTRIBUTE):
            parsed.tally.drop(f"columns {quoted(name)}")
    return parsed


def _read_row(
    row: Mapping[str, str | None],
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    if "more" in row or None in row.values():
        raise SemvizError("more or fewer values than the header has names")
    values = {name: cell_text(text.strip()) for name, text in row.items() if text is not None}
    context.check_frame(values.get("frame") or None)
    class_id = context.class_id(values["class"])
    if class_id is None:
        return parsed.tally.drop("rows of a class that is ignored, as asked")
    anchor, end = _numbers(values, ANCHOR), _numbers(values, END)
    if anchor is None:
        raise SemvizError(f"no numbers in {', '.join(ANCHOR)}")
    is_line = context.classes[class_id].kind == "line"
    if is_line != (end is not None):
        name = quoted(values["class"])
        raise SemvizError(f"{name} {'without' if is_line else 'with'} an end; {', '.join(END)}")
    anchor_known, end_known = (_flag(values.get(name, ""), name) for name in KNOWN)
    id_, covariance = conversion.parse_integer(values.get("id")), _covariance(values, is_line)
    own = {name: text for name, text in values.items() if name.startswith(ATTRIBUTE) and text}
    attributes = parsed_attributes({name.removeprefix(ATTRIBUTE): own[name] for name in own})
    parsed.add(
        conversion.ParsedElement(
            class_id, anchor, end, id_, covariance, anchor_known, end_known, attributes=attributes
        )
    )
    return None


def _numbers(values: Mapping[str, str], names: tuple[str, ...]) -> FloatArray | None:
    """Return the numbers in some columns; None if all are empty or missing."""
    texts = [values.get(name, "") for name in names]
    return np.array([number(text) for text in texts]) if any(texts) else None


def _covariance(values: Mapping[str, str], is_line: bool) -> FloatArray | None:
    names = SIGMA if is_line else SIGMA[:3]
    sigmas = _numbers(values, names)
    if sigmas is None:
        return None
    if (sigmas < 0.0).any():
        raise SemvizError(f"a negative standard deviation in {', '.join(names)}")
    variances = np.zeros(6)
    variances[: len(sigmas)] = sigmas**2
    return np.diag(variances)


def _flag(text: str, name: str) -> bool:
    if text.lower() not in _FLAGS:
        raise SemvizError(f"{name} is neither true nor false but {quoted(text)}")
    return _FLAGS[text.lower()]

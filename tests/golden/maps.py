"""G4: maps built from the labels of three workspaces, by each method."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from golden import workspaces
from golden.canonical import digest
from golden.command import call
from golden.files import table_content
from semviz import load_map

WAYS = {
    "town joint": ("town",),
    "town refined": ("town", "--refine-poses"),
    "town paper": ("town", "--method", "paper"),
    "lane joint": ("lane", "--sigma-px", "1.5"),
    "lane sure": ("lane", "--sigma-px", "1.5", "--min-frames", "2"),
    "lane paper": ("lane", "--method", "paper", "--min-points", "2"),
    "mono joint": ("mono",),
    "mono some": ("mono", "--frames", "0:12:2"),
}
PLACES = "places: "
"""Prefix of the keys of positions, which are compared to a micrometre on other machines."""


def golden_values(folder: Path) -> dict[str, Any]:
    """Return the content of each map file to the last bit, and its portable part."""
    for name in workspaces.NAMES:
        workspaces.make(folder, name)
    found: dict[str, Any] = {}
    for name, (workspace, *options) in WAYS.items():
        output = call(folder, "map", "build", workspace, "--name", "built", "--json", *options)
        path = folder / workspace / "maps" / "built.parquet"
        found[name] = table_content(path)
        found[f"words: {name}"] = digest(
            [decision["reason"] for decision in _decisions(output, path)]
        )
        found |= _portable_values(name, output, path)
    return found


def _decisions(output: str, path: Path) -> list[Any]:
    return list(json.loads(output).get("decisions", [])) or [
        {"reason": decision.reason} for decision in load_map(path).decisions
    ]


def _portable_values(name: str, output: str, path: Path) -> dict[str, Any]:
    """Return counts and decisions, equal on all machines, and positions of elements in metres."""
    report, built = json.loads(output), load_map(path)
    elements = built.elements
    about = [
        (decision.kind, decision.label_ids, decision.observation_ids, decision.by)
        for decision in built.decisions
    ]
    kinds = {"id": elements.id, "class": elements.class_id, "known": elements.end_known}
    counts = {key: value for key, value in report.items() if isinstance(value, int)}
    places = np.column_stack([elements.anchor_m, elements.end_m])
    return {
        f"{name}: counts": counts,
        f"{name}: elements": digest(kinds),
        f"{name}: decisions": digest(about),
        f"{name}: provenance": digest(built.provenance),
        f"{PLACES}{name}": [[_metres(value_m) for value_m in row] for row in places.tolist()],
    }


def _metres(value: float) -> float | None:
    return round(value, 6) if np.isfinite(value) else None

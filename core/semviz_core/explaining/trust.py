"""How sure verdicts are: of those of each kind, the share that was right on planted faults.

Printed by bench/verdicts.py on seeds below 1000, each kind planted as often as any other, by
Laplace's rule. Where some faults are rarer than others in truth, so is being misled by them.
"""

from typing import get_args

from semviz_core.explaining.told import Kind, Knowledge

UNMEASURED = 0.5
"""Of kinds that are never planted in single frames."""
_WITH_IDS: dict[Kind, float] = {
    "healthy": 0.99,
    "too few elements": 0.99,
    "missed detection": 0.99,
    "false detection": 0.99,
    "wrong class": 0.99,
    "not in the submap": 0.99,
    "moved in the map": 0.99,
    "missing in the map": 0.99,
    "twice in the map": 0.99,
    "wrong matches": 0.99,
    "search miss": 0.96,
    "refinement diverged": 0.99,
    "ambiguous geometry": 0.98,
}
_WITH_POSE: dict[Kind, float] = _WITH_IDS | {
    "healthy": 0.98,
    "false or not mapped": 0.99,
    "moved in the map": 0.51,
    "ambiguous geometry": 0.89,
}
_BLIND: dict[Kind, float] = {
    "healthy": 0.98,
    "too few elements": 0.87,
    "missed detection": 0.78,
    "wrong class": 0.99,
    "false or not mapped": 0.91,
    "not in the submap": 0.32,
    "moved in the map": 0.38,
    "twice in the map": 0.99,
    "refinement diverged": 0.98,
    "ambiguous geometry": 0.84,
}
SURE: dict[Knowledge, dict[Kind, float]] = {
    knowledge: {kind: shares.get(kind, UNMEASURED) for kind in get_args(Kind)}
    for knowledge, shares in zip(get_args(Knowledge), (_WITH_IDS, _WITH_POSE, _BLIND), strict=True)
}

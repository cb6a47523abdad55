"""How sure a diagnosis is, and what would make an unsure one sure.

The confidence of a kind is the share of its diagnoses that were right on planted faults, by
Laplace's rule: every kind planted equally often, and as often faults of no kind (lens distortion,
a rolling shutter, a mirrored or resized image), where "unexplained" is right.
`bench/diagnosis_reliability.py` measures it on seeds below 1000, and judges it on others. Where a
fault is rarer in practice, wrong diagnoses of it are more frequent.
"""

from typing import get_args

from semviz_core.diagnosis.fault import FaultKind, GroundTruthLevel

UNMEASURED = 0.5
"""Confidence of kinds that are never planted in single frames."""
SURE = 0.8
"""From this confidence on, a diagnosis needs nothing to tell it from others."""
_WITH_IDS: dict[FaultKind, float] = {
    "healthy": 0.98,
    "too few elements": 0.99,
    "missed detection": 0.84,
    "ambiguous geometry": 0.91,
    "wrong class": 0.96,
    "not in the submap": 0.99,
    "moved in the map": 0.66,
    "missing in the map": 0.97,
    "twice in the map": 0.80,
    "wrong matches": 0.99,
    "search miss": 0.94,
    "refinement diverged": 0.99,
    "wrong heading prior": 0.99,
    "wrong gravity prior": 0.99,
    "wrong height prior": 0.99,
    "wrong position prior": 0.99,
    "wrong detection sigma": 0.62,
    "misaligned map": 0.79,
    "unexplained": 0.98,
}
_WITH_POSE: dict[FaultKind, float] = {
    "healthy": 0.98,
    "too few elements": 0.99,
    "missed detection": 0.86,
    "ambiguous geometry": 0.84,
    "wrong class": 0.96,
    "not in the submap": 0.99,
    "false or not mapped": 0.97,
    "moved in the map": 0.32,
    "misaligned map": 0.77,
    "twice in the map": 0.80,
    "wrong matches": 0.99,
    "search miss": 0.94,
    "refinement diverged": 0.99,
    "wrong heading prior": 0.99,
    "wrong gravity prior": 0.99,
    "wrong height prior": 0.99,
    "wrong position prior": 0.99,
    "wrong detection sigma": 0.71,
    "unexplained": 0.98,
}
_BLIND: dict[FaultKind, float] = {
    "healthy": 0.98,
    "too few elements": 0.87,
    "missed detection": 0.80,
    "ambiguous geometry": 0.69,
    "false or not mapped": 0.57,
    "wrong class": 0.94,
    "not in the submap": 0.93,
    "moved in the map": 0.19,
    "twice in the map": 0.80,
    "wrong matches": 0.99,
    "wrong height prior": 0.94,
    "unexplained": 0.59,
    "refinement diverged": 0.96,
    "search miss": 0.99,
    "wrong heading prior": 0.99,
    "wrong gravity prior": 0.99,
    "wrong position prior": 0.98,
    "wrong detection sigma": 0.26,
}
CONFIDENCE: dict[GroundTruthLevel, dict[FaultKind, float]] = {
    knowledge: {kind: shares.get(kind, UNMEASURED) for kind in get_args(FaultKind)}
    for knowledge, shares in zip(
        get_args(GroundTruthLevel), (_WITH_IDS, _WITH_POSE, _BLIND), strict=True
    )
}
_TELLS_APART: dict[FaultKind, str] = {
    "moved in the map": "Other frames tell it from a false detection beside a missing element: "
    "one that moved is at one place in all of them.",
    "twice in the map": "The map tells: two elements of a class within a metre, of which frames "
    "never show both, are one.",
    "false or not mapped": "Other frames tell: what they show at one place is not in the map, "
    "what one frame shows alone is false.",
    "false detection": "The image tells whether something is there.",
    "missing in the map": "Other frames tell: what they show at one place is not in the map.",
    "wrong class": "The image tells the class.",
    "too few elements": "The image tells: elements in view that have no detection were missed.",
    "missed detection": "The image tells: elements in view that have no detection were missed.",
    "ambiguous geometry": "A heading prior, a narrower position prior or the next frames (--track) "
    "tell the poses apart.",
    "wrong detection sigma": "The run tells: errors that follow one pattern over the image are of "
    "the lens or the calibration, random ones of the detector.",
    "misaligned map": "The run tells a shifted map, another mounting, another time and another "
    "calibration apart, if the road turns.",
    "unexplained": "The true pose or labels of this frame tell which link of the chain is broken.",
    "search miss": "A what-if with forced pairs tells whether the wider search is right.",
    "wrong matches": "A what-if with forced pairs tells whether the preferred pairs are wrong.",
}


def what_tells_apart(kind: FaultKind, confidence: float) -> str:
    """Return what would tell an unsure diagnosis from its rivals; empty for a sure one."""
    return "" if confidence >= SURE else _TELLS_APART.get(kind, "")

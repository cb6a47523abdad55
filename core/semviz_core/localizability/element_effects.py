"""Rank elements by their effect on a route: where to add one, and which ones are critical.

Suggestions are chosen greedily, each given the previous ones. Critical elements are ranked by the
loss of each one alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements3D
from semviz_core.common.arrays import FloatArray
from semviz_core.localizability.expected_error import (
    ElementInformation,
    PositionInformation,
    information_in_view,
)
from semviz_core.localizability.route import Conditions

MIN_TOTAL_M2 = 1.0
"""Changes with a smaller sum over the route are not reported."""
EFFECT_SHARE = 0.1
"""A change is reported over the stretch in which it is at least this share of its maximum."""
_CANDIDATES = 1
"""Part of the seed that separates draws for candidates from those for mapped elements."""


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of adding or losing an element, over the stretch that it affects."""

    element: Elements3D
    """(1,) the element."""
    first_m: float
    """Distance along the route to the begin of the stretch."""
    last_m: float
    before_m: float
    """Mean of ``Localizability.expected_m`` over the stretch."""
    after_m: float
    """The same with the change."""
    total_m2: float
    """Its change, integrated over the whole route."""


def suggest(
    informations: Sequence[PositionInformation],
    along_m: FloatArray,
    candidates: Elements3D,
    camera: Camera,
    conditions: Conditions,
    count: int,
) -> tuple[Effect, ...]:
    """Return the up to ``count`` best candidates, chosen greedily, each given the previous ones.

    ``informations`` are those of the positions ``along_m`` (k,). Candidates that help less than
    MIN_TOTAL_M2 are left out.
    """
    positions = list(informations)
    in_view = [
        information_in_view(
            candidates, camera, position.T_map_camera, conditions,
            np.random.default_rng([conditions.seed, number, _CANDIDATES]),
        )
        for number, position in enumerate(positions)
    ]  # fmt: skip
    gains = [
        _gains(position, visible) for position, visible in zip(positions, in_view, strict=True)
    ]
    chosen: list[Effect] = []
    for _ in range(count):
        effect = _largest_effects(positions, along_m, in_view, gains, candidates, 1)
        if not effect:
            break
        chosen += effect
        for k, visible in enumerate(in_view):
            for i in np.flatnonzero(visible.id == effect[0].element.id[0]).tolist():
                positions[k] = positions[k].with_element(visible, i)
                in_view[k] = visible.without(i)
                gains[k] = _gains(positions[k], in_view[k])
    return tuple(chosen)


def critical(
    positions: Sequence[PositionInformation], along_m: FloatArray, elements: Elements3D, count: int
) -> tuple[Effect, ...]:
    """Return the up to ``count`` mapped elements whose loss, each alone, costs most."""
    losses = [_losses(position) for position in positions]
    return _largest_effects(
        positions, along_m, [position.elements for position in positions], losses, elements, count
    )


def _gains(position: PositionInformation, candidates: ElementInformation) -> FloatArray:
    """Return (m,) the change of the expected error with each candidate: 0 or less."""
    after = [position.with_element(candidates, i).expected_m for i in range(len(candidates.id))]
    return np.array(after) - position.expected_m


def _losses(position: PositionInformation) -> FloatArray:
    """Return (m,) the change of the expected error without each element in view: 0 or more."""
    after = [position.without_element(i).expected_m for i in range(len(position.elements.id))]
    return np.array(after) - position.expected_m


def _largest_effects(
    positions: Sequence[PositionInformation],
    along_m: FloatArray,
    in_view: Sequence[ElementInformation],
    changes: Sequence[FloatArray],
    elements: Elements3D,
    count: int,
) -> tuple[Effect, ...]:
    """Return the effects of the ``count`` elements with the largest changes, largest first."""
    ids = np.concatenate([visible.id for visible in in_view])
    position_row = np.repeat(np.arange(len(in_view)), [len(visible.id) for visible in in_view])
    change = np.concatenate(changes)
    step_m = np.gradient(along_m) if len(along_m) > 1 else np.ones(1)
    unique, index = np.unique(ids, return_inverse=True)
    total = np.bincount(index, change * step_m[position_row], minlength=len(unique))
    order = np.argsort(-np.abs(total), kind="stable")[:count]
    before_m = np.array([information.expected_m for information in positions])
    effects = []
    for row in order[np.abs(total[order]) >= MIN_TOTAL_M2]:
        change_m = np.zeros(len(in_view))
        change_m[position_row[index == row]] = change[index == row]
        element = elements[elements.id == unique[row]]
        effects.append(_effect(element, along_m, before_m, change_m, float(total[row])))
    return tuple(effects)


def _effect(
    element: Elements3D,
    along_m: FloatArray,
    before_m: FloatArray,
    change_m: FloatArray,
    total_m2: float,
) -> Effect:
    """Return the effect over the stretch around its largest change (k,)."""
    stretch = _affected_stretch(np.abs(change_m))
    return Effect(
        element,
        first_m=float(along_m[stretch][0]),
        last_m=float(along_m[stretch][-1]),
        before_m=float(before_m[stretch].mean()),
        after_m=float((before_m + change_m)[stretch].mean()),
        total_m2=total_m2,
    )


def _affected_stretch(change: FloatArray) -> slice:
    """Return the positions around the largest change (k,) that reach ``EFFECT_SHARE`` of it."""
    unaffected = np.flatnonzero(change < EFFECT_SHARE * change.max())
    peak = int(change.argmax())
    first, last = unaffected[unaffected < peak], unaffected[unaffected > peak]
    return slice(first[-1] + 1 if len(first) else 0, last[0] if len(last) else len(change))

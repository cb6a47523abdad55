"""What one element more, or one less, does to a route: where to put a new one, which to keep."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements3D
from semviz_core.localizability.conditions import Conditions
from semviz_core.localizability.outlook import Outlook, Parts, parts_in_view

LEAST_TOTAL_M2 = 1.0
"""A change of the expected error that comes to less over the route is not worth telling."""
FELT = 0.1
"""A change is told over the stretch in which it is at least this share of its largest."""
_CANDIDATES = 1
"""Tells draws for candidates from those for what stands there."""


@dataclass(frozen=True, eq=False)
class Effect:
    """What adding or losing an element does, over the stretch where it is felt."""

    element: Elements3D
    """(1,) the element."""
    first_m: float
    """Along the route, where the stretch begins."""
    last_m: float
    before_m: float
    """Mean of ``Localizability.expected_m`` over the stretch."""
    after_m: float
    """The same with the change."""
    total_m2: float
    """The change of it over the whole route: metres times metres of route."""


def suggest(
    outlooks: Sequence[Outlook],
    along_m: FloatArray,
    candidates: Elements3D,
    camera: Camera,
    conditions: Conditions,
    count: int,
) -> tuple[Effect, ...]:
    """Those ``count`` of ``candidates`` that help most, each beside the ones before it (greedily).

    None that help less than LEAST_TOTAL_M2.
    """
    now = list(outlooks)
    parts = [
        parts_in_view(
            candidates, camera, one.T_map_camera, conditions,
            np.random.default_rng([conditions.seed, number, _CANDIDATES]),
        )
        for number, one in enumerate(now)
    ]  # fmt: skip
    gains = [_gains(one, some) for one, some in zip(now, parts, strict=True)]
    chosen: list[Effect] = []
    for _ in range(count):
        effect = _greatest(now, along_m, parts, gains, candidates, 1)
        if not effect:
            break
        chosen += effect
        for k, some in enumerate(parts):
            for i in np.flatnonzero(some.id == effect[0].element.id[0]).tolist():
                now[k] = now[k].with_part(some, i)
                parts[k] = some.without(i)
                gains[k] = _gains(now[k], parts[k])
    return tuple(chosen)


def critical(
    outlooks: Sequence[Outlook], along_m: FloatArray, elements: Elements3D, count: int
) -> tuple[Effect, ...]:
    """Those ``count`` of the mapped ``elements`` whose loss costs most, each by itself."""
    losses = [_losses(one) for one in outlooks]
    return _greatest(outlooks, along_m, [one.parts for one in outlooks], losses, elements, count)


def _gains(outlook: Outlook, parts: Parts) -> FloatArray:
    """(m,) change of the expected error with each element of ``parts``: 0 or less."""
    after = [outlook.with_part(parts, i).expected_m for i in range(len(parts.id))]
    return np.array(after) - outlook.expected_m


def _losses(outlook: Outlook) -> FloatArray:
    """(m,) change of the expected error without each element in view: 0 or more."""
    after = [outlook.without_part(i).expected_m for i in range(len(outlook.parts.id))]
    return np.array(after) - outlook.expected_m


def _greatest(
    outlooks: Sequence[Outlook],
    along_m: FloatArray,
    parts: Sequence[Parts],
    changes: Sequence[FloatArray],
    elements: Elements3D,
    count: int,
) -> tuple[Effect, ...]:
    """Effects of the ``count`` elements that change most, the greatest first."""
    ids = np.concatenate([one.id for one in parts])
    position = np.repeat(np.arange(len(parts)), [len(one.id) for one in parts])
    change = np.concatenate(changes)
    step_m = np.gradient(along_m) if len(along_m) > 1 else np.ones(1)
    unique, which = np.unique(ids, return_inverse=True)
    total = np.bincount(which, change * step_m[position], minlength=len(unique))
    order = np.argsort(-np.abs(total), kind="stable")[:count]
    before_m = np.array([one.expected_m for one in outlooks])
    effects = []
    for at in order[np.abs(total[order]) >= LEAST_TOTAL_M2]:
        change_m = np.zeros(len(parts))
        change_m[position[which == at]] = change[which == at]
        element = elements[elements.id == unique[at]]
        effects.append(_effect(element, along_m, before_m, change_m, float(total[at])))
    return tuple(effects)


def _effect(
    element: Elements3D,
    along_m: FloatArray,
    before_m: FloatArray,
    change_m: FloatArray,
    total_m2: float,
) -> Effect:
    """Told over the stretch around its largest change (k,) in which it is felt."""
    felt = _felt(np.abs(change_m))
    return Effect(
        element,
        first_m=float(along_m[felt][0]),
        last_m=float(along_m[felt][-1]),
        before_m=float(before_m[felt].mean()),
        after_m=float((before_m + change_m)[felt].mean()),
        total_m2=total_m2,
    )


def _felt(change: FloatArray) -> slice:
    """The positions (k,) around the largest change, as far as it is felt."""
    weak = np.flatnonzero(change < FELT * change.max())
    peak = int(change.argmax())
    first, last = weak[weak < peak], weak[weak > peak]
    return slice(first[-1] + 1 if len(first) else 0, last[0] if len(last) else len(change))

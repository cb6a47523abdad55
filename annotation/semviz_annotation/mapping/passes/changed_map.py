"""The map after the changes that a person chose to make."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.labels.rows import derived_id
from semviz_annotation.mapping.passes.changes import Change, MapChanges
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.semantic_map import Decision, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError

_SURE_LOG_ODDS = 9.0
"""Of an element that passes found: beyond ``> 99.9 %``."""


def changed_map(found: MapChanges, made: Collection[str]) -> SemanticMap:
    """Return the map after the changes named ``made``; everything else stays.

    What vanished, or may have, is left out with its attributes; what is new is added; what moved
    stands in its new place with its number, provenance and attributes. Raise SemvizError for
    a name that is no change.
    """
    if unknown := sorted(set(made) - {change.name for change in found.changes}):
        raise SemvizError(f"{unknown[0]} is no change of this map; leave it out")
    base, chosen = found.semantic_map, [each for each in found.changes if each.name in made]
    elements = base.elements
    provenance = list(base.provenance or (Provenance(),) * len(base))
    for change in chosen:
        if change.kind == "moved":
            elements = _moved(elements, found, change)
    gone = [each.element_id for each in chosen if each.kind in ("vanished", "unsure")]
    stays = np.flatnonzero(~np.isin(elements.id, np.array(gone, np.int64)))
    elements, provenance = elements[stays], [provenance[row] for row in stays.tolist()]
    for change in chosen:
        if change.kind == "new":
            elements = joined(elements, found.whole[[change.row]])
            source = derived_id(f"{change.name} of {found.passes}")
            provenance.append(Provenance((source,), (), _SURE_LOG_ODDS))
    present = set(elements.id.tolist())
    return replace(
        base,
        elements=elements,
        provenance=tuple(provenance),
        decisions=(*base.decisions, *_decisions(chosen)),
        made_by=f"{base.made_by}; changed by {len(found.passes)} passes".removeprefix("; "),
        settings={},
        attributes={id_: of for id_, of in base.attributes.items() if id_ in present},
    )


def _moved(elements: Elements3D, found: MapChanges, change: Change) -> Elements3D:
    """Return the elements with one in its new place, in the same row."""
    row = found.row_in_map(change)
    new = replace(found.whole[[change.row]], id=elements.id[[row]])
    others = np.delete(np.arange(len(elements)), row)
    back = np.argsort(np.append(others, row), kind="stable")
    return joined(elements[others], new)[back]


def _decisions(chosen: Sequence[Change]) -> list[Decision]:
    return [
        Decision(
            "leave out", (), (), "human", f"{change.name} {change.story}",
            {"existence": change.existence},
        )
        for change in chosen
        if change.kind in ("vanished", "unsure")
    ]  # fmt: skip

"""A frame of a run solved again, with something changed; from the run alone."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz.recording.run import FrameRecord, Run
from semviz.trying.asked import Asked
from semviz.trying.change import Change
from semviz.trying.own_matches import from_own_matches
from semviz.trying.pair_changes import pairing_of
from semviz_core.localization import Localization
from semviz_core.localize import METHODS
from semviz_core.semantic_map import SemanticMap


def again(run: Run, record: FrameRecord, changes: Sequence[Change] = ()) -> FrameRecord:
    """The frame with its new answer; without changes, as it was answered.

    Raises SemvizError where changes contradict each other, or name what is not there.
    """
    asked = Asked.of(run, record)
    asked = replace(asked, semantic_map=changed_map(run.semantic_map, changes))
    for one in sorted(changes, key=lambda one: one.stage):
        if one.concerns(asked):
            asked = one.applied(asked)
    found = _localized(asked) if asked.matched is None else from_own_matches(asked)
    return replace(record, localization=found, element_id=asked.element_id)


def _localized(asked: Asked) -> Localization:
    return asked.localizer.localize(
        asked.observed,
        asked.submap,
        asked.record.localization.camera,
        asked.prior,
        pairing=pairing_of(asked),
        start=asked.start,
    )


def as_asked(run: Run, record: FrameRecord) -> FrameRecord:
    """What answers with changes are compared with: the frame as recorded; of a run that followed
    the camera, the frame by itself."""
    return record if run.info.method in METHODS else again(run, record)


def changed_map(semantic_map: SemanticMap, changes: Sequence[Change]) -> SemanticMap:
    """The whole map with the changes that are about it; the same one without any."""
    elements = semantic_map.elements
    for one in changes:
        elements = one.mended(elements)
    if elements is semantic_map.elements:
        return semantic_map
    kept = np.flatnonzero(np.isin(semantic_map.elements.id, elements.id))
    known = semantic_map.provenance
    provenance = tuple(known[row] for row in kept) if known else ()
    return replace(semantic_map, elements=elements, provenance=provenance)

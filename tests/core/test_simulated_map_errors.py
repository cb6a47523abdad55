"""Faulty maps are faulty in the way and to the degree they claim."""

import numpy as np
import pytest

from semviz_core.base.semantic_map import Provenance, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.research.evaluation import roads
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street


@pytest.fixture(scope="module")
def truth() -> SemanticMap:
    return Street(9, StreetOptions(frames=250)).truth_map


def test_shares_of_missing_obsolete_and_duplicated(truth: SemanticMap) -> None:
    missing, obsolete, duplicated = [], [], []
    for seed in range(60):
        elements = roads.with_errors(truth, seed).elements
        known = elements.id <= truth.elements.id.max()
        true = truth.elements[np.searchsorted(truth.elements.id, elements.id[known])]
        away = np.linalg.norm(elements.anchor_m[known] - true.anchor_m, axis=1)
        assert ((away < 1.0) | (np.abs(away - 8.0) < 1.0)).all()
        missing.append(1.0 - known.sum() / len(truth))
        obsolete.append((away > 4.0).mean())
        duplicated.append((~known).sum() / len(truth))
    assert np.mean(missing) == pytest.approx(0.05, abs=0.01)
    assert np.mean(obsolete) == pytest.approx(0.05, abs=0.01)
    assert np.mean(duplicated) == pytest.approx(0.03, abs=0.01)


def test_covariances_are_honest(truth: SemanticMap) -> None:
    """Squared errors over their covariance average the number of coordinates."""
    points, lines, heights = [], [], []
    for seed in range(40):
        elements = roads.with_errors(truth, seed).elements
        known = elements[elements.id <= truth.elements.id.max()]
        true = truth.elements[np.searchsorted(truth.elements.id, known.id)]
        error = np.concatenate([known.anchor_m - true.anchor_m, known.end_m - true.end_m], axis=1)
        kept = np.linalg.norm(error[:, :3], axis=1) < 4.0
        for e, C, line in zip(
            error[kept], known.covariance_m2[kept], known.is_line[kept], strict=True
        ):
            n = 6 if line else 3
            nees = e[:n] @ np.linalg.pinv(C[:n, :n], rcond=1e-9) @ e[:n]
            (lines if line else points).append(nees / np.linalg.matrix_rank(C[:n, :n], tol=1e-9))
            heights.append(e[2])
    assert np.mean(points) == pytest.approx(1.0, abs=0.05)
    assert np.mean(lines) == pytest.approx(1.0, abs=0.05)
    assert np.std(heights) == pytest.approx(0.02, rel=0.1)


def test_the_same_seed_errs_the_same(truth: SemanticMap) -> None:
    assert roads.with_errors(truth, 1).digest == roads.with_errors(truth, 1).digest
    assert roads.with_errors(truth, 1).digest != roads.with_errors(truth, 2).digest


def test_one_fault_touches_one_element(truth: SemanticMap) -> None:
    element_id = int(truth.elements.id[5])
    moved = roads.move_element(truth, element_id, [3.0, -1.0, 0.0]).elements
    change = moved.anchor_m - truth.elements.anchor_m
    assert np.allclose(change[5], [3.0, -1.0, 0.0])
    assert not np.delete(change, 5, axis=0).any()
    gone = roads.remove_element(truth, element_id).elements
    assert element_id not in gone.id
    assert len(gone) == len(truth) - 1
    twice = roads.duplicate_element(truth, element_id, [0.5, 0.0, 0.0]).elements
    assert len(twice) == len(truth) + 1
    assert twice.id[-1] == truth.elements.id.max() + 1
    assert np.allclose(twice.anchor_m[-1] - truth.elements.anchor_m[5], [0.5, 0.0, 0.0])


def test_provenance_stays_with_its_element(truth: SemanticMap) -> None:
    from dataclasses import replace

    told = replace(truth, provenance=tuple(Provenance((f"label {i}",)) for i in truth.elements.id))
    element_id = int(truth.elements.id[5])
    assert told.provenance[5] not in roads.remove_element(told, element_id).provenance
    assert len(roads.remove_element(told, element_id).provenance) == len(truth) - 1
    assert roads.duplicate_element(told, element_id, [0, 0, 0]).provenance[-1] == told.provenance[5]


def test_what_is_not_there_cannot_be_moved(truth: SemanticMap) -> None:
    with pytest.raises(SemvizError, match="street-9 has no element 12345"):
        roads.move_element(truth, 12345, [1.0, 0.0, 0.0])

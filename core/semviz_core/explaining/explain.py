"""Why a frame came out as it did, on one screen: the first broken link of the method's chain."""

import numpy as np

from semviz_core.detector_model import DetectorModel
from semviz_core.explaining.case import Case, is_healthy
from semviz_core.explaining.faults import noticed
from semviz_core.explaining.links import (
    fixed,
    found_truth,
    in_submap,
    matched,
    pairs_possible,
    refined,
    searched,
    seen_enough,
)
from semviz_core.explaining.told import Evidence, Fault, Knowledge, Truth, Verdict
from semviz_core.explaining.trust import SURE
from semviz_core.localization import Localization
from semviz_core.semantic_map import SemanticMap


def explain(
    localization: Localization,
    semantic_map: SemanticMap,
    truth: Truth | None = None,
    detector: DetectorModel | None = None,
) -> Verdict:
    """What became of a frame, told with all that is known of it.

    ``semantic_map`` is the map that the submap was cropped from; ``detector`` as the localizer's.
    """
    case = Case.of(localization, semantic_map, truth, detector)
    knowledge: Knowledge = "nothing" if truth is None else truth.knowledge
    faults = noticed(case)
    fault = _healthy(case) if is_healthy(localization, case.truth) else _broken(case, faults)
    return Verdict(fault, SURE[knowledge][fault.kind], faults)


def _healthy(case: Case) -> Fault:
    one = case.localization
    fit = 0 if one.refinement is None else int(one.refinement.inlier.sum())
    sentence = f"{fit} of {len(one.observed)} elements fit."
    return Fault("healthy", sentence, (Evidence("fit", fit),))


def _broken(case: Case, faults: tuple[Fault, ...]) -> Fault:
    """The first broken link of a frame that was not answered, or not rightly.

    Where the search found the truth, all links before refinement held.
    """
    return (
        (refined(case) if found_truth(case) else None)
        or seen_enough(case)
        or in_submap(case)
        or pairs_possible(case, faults)
        or matched(case)
        or searched(case)
        or refined(case)
        or fixed(case)
        or _unexplained(case)
    )


def _unexplained(case: Case) -> Fault:
    one = case.localization
    assert one.T_camera_map is not None
    off = (case.truth @ one.T_camera_map.inverse()).log() if case.truth else np.zeros(6)
    chi2 = np.nan
    if one.covariance is not None:
        chi2 = float(off @ np.linalg.solve(one.covariance, off))
    sentence = "The answer is off, though no link of the method is seen to break."
    return Fault("unexplained", sentence, (Evidence("squared error over covariance", chi2),))

"""How sigmas of what was chosen among candidates are to be changed: ``sigma.CHOSEN``, fitted on
tuning streets with what the detector finds there, once all other weights are as they should be.

    python bench/measure_chosen.py
"""

import numpy as np
from measure_fit import Sample, likeliest

from semviz_core.detection import sigma
from semviz_core.detection.models import load_detector
from semviz_core.evaluation.detection import matched
from semviz_core.evaluation.sigma_check import errors_and_sigmas
from semviz_core.evaluation.street_truth import street_truth
from semviz_core.sources.street.street import Street

SEEDS = range(20_100, 20_120)
FRAMES = (5, 17, 29, 41, 53)
LARGEST_PX = 20.0
"""Errors count as this at most."""
WHAT = {"signs": "middle", "poles, across": "across", "poles, along": "along"}


def main() -> None:
    sigma.CHOSEN = dict.fromkeys(sigma.CHOSEN, (0.0, 1.0))
    samples: dict[str, list[Sample]] = {what: [] for what in sigma.CHOSEN}
    detector = load_detector()
    for seed in SEEDS:
        street = Street(seed)
        for index in FRAMES:
            found = detector.detect(street.image(index, "left"))
            truth = street_truth(street, index, "left")
            rows = matched(found, truth)
            right = rows >= 0
            told = errors_and_sigmas(found[right], truth.elements[rows[right]])
            for name, (errors_px, sigmas_px) in told.items():
                samples[WHAT[name]] += [
                    Sample(name, np.log([said]), float(off))
                    for off, said in zip(errors_px, sigmas_px, strict=True)
                ]
    print({what: likeliest(of, LARGEST_PX) for what, of in samples.items()})


if __name__ == "__main__":
    main()

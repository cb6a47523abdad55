"""Fit ``regions.CHOSEN``, the change of sigma for elements chosen among candidates, to detections
on tuning streets, after all other weights were fitted.

    python bench/subpixel_chosen.py
"""

import numpy as np
from subpixel_fit import Sample, likeliest

from semviz_core.detection import regions
from semviz_core.detection.detector import load_detector
from semviz_core.metrics.detection import match_detections
from semviz_core.metrics.detection_summary import errors_and_sigmas
from semviz_core.simulation.ground_truth import street_truth
from semviz_core.simulation.street import Street

SEEDS = range(20_100, 20_120)
FRAMES = (5, 17, 29, 41, 53)
LARGEST_PX = 20.0
"""Errors count as this at most."""
WHAT = {"signs": "center", "poles, across": "across", "poles, along": "along"}


def main() -> None:
    regions.CHOSEN = dict.fromkeys(regions.CHOSEN, (0.0, 1.0))
    samples: dict[str, list[Sample]] = {what: [] for what in regions.CHOSEN}
    detector = load_detector()
    for seed in SEEDS:
        street = Street(seed)
        for index in FRAMES:
            found = detector.detect(street.image(index, "left"))
            truth = street_truth(street, index, "left")
            rows = match_detections(found, truth)
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

"""Fit ``regions.CHOSEN``, the change of sigma for elements chosen among candidates, to detections
on tuning streets, after all other weights were fitted: half of them from the network's regions,
half from masks that end early.

    python bench/subpixel_chosen.py
"""

import numpy as np
from subpixel_fit import Sample, likeliest
from subpixel_regions import masked_in_part, shown

from semviz_core.detection import regions
from semviz_core.detection.detector import load_region_model, measure
from semviz_core.metrics.detection import match_detections
from semviz_core.metrics.detection_summary import errors_and_sigmas

SEEDS = range(20_100, 20_114)
LARGEST_PX = 30.0
"""Errors count as this at most."""
WHAT = {"signs": "center", "poles, across": "across", "poles, along": "along"}


def main() -> None:
    regions.CHOSEN = dict.fromkeys(regions.CHOSEN, (0.0, 1.0))
    samples: dict[str, list[Sample]] = {what: [] for what in regions.CHOSEN}
    model = load_region_model()
    for view in shown(SEEDS):
        for found in (model.find(view.picture.image), masked_in_part(view)[0]):
            elements = measure(view.picture, found)
            rows = match_detections(elements, view.truth)
            right = rows >= 0
            told = errors_and_sigmas(elements[right], view.truth.elements[rows[right]])
            for name, (errors_px, sigmas_px) in told.items():
                samples[WHAT[name]] += [
                    Sample(name, np.log([said]), float(off))
                    for off, said in zip(errors_px, sigmas_px, strict=True)
                ]
    print({what: likeliest(of, LARGEST_PX) for what, of in samples.items()})


if __name__ == "__main__":
    main()

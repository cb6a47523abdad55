"""Maps after planted faults of poses: is their uncertainty honest, before and after refining?

    OMP_NUM_THREADS=1 python bench/pose_maps.py [--seeds 2000 2001] [--tracks FOLDER]

Streets of 40 frames, labelled in all frames with errors of 0.5 px. Each fault of ``pose_faults``
that holds for some frames is planted into exact poses, and into poses with errors of 1 cm and 0.02
deg from frame to frame. Maps are built with the given poses, and with refined poses where a fault
was found ('semviz poses choose refine').

Columns, of elements labelled in the frames of the fault: median error of the position; NEES, the
squared error over its stated covariance by degree of freedom (1 where both agree; signs have 3,
poles 2 on the ground), as a mean, and as the median over that of a chi-squared variable, which
single wrong elements do not decide.
"""

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from pose_faults import FRAMES, NOISE, Drive, opened
from scipy.stats import chi2
from support.planted_pose_faults import POSE_FAULTS, PlantedFault, noisy
from support.street_labels import careful, label_street

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import footprint_covariance_m2, footprint_m
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import DatasetWithFrames
from semviz_core.pose_checks.faults import PoseCheck, check_drive, pose_covariance, refined_frames
from semviz_core.pose_checks.pose_covariance import PoseCovariance
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

LABEL_PX = 0.5
DRAWS = 3
"""Elements of a street share the errors of its poses, so each street gets several sequences."""


def wrong_frames(check: PoseCheck) -> set[int]:
    """Return the frames that somebody would refine: all for a fault of the whole drive."""
    whole = any(fault.kind in ("axes", "time", "heights") for fault in check.faults)
    return {frame.index for frame in check.frames} if whole else set(check.wrong_frames)


def repaired(check: PoseCheck) -> tuple[Frame, ...]:
    """Return the frames with refined poses where a fault was found."""
    wrong = wrong_frames(check)
    pairs = zip(check.frames, refined_frames(check), strict=True)
    return tuple(refined if given.index in wrong else given for given, refined in pairs)


def errors(
    street: Street,
    labels: Labels,
    true_id: dict[str, int],
    frames: Sequence[Frame],
    inside: set[int],
    poses: PoseCovariance | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return error (m), squared normalized error and degrees of freedom of elements concerned."""
    try:
        built, _ = build_map(
            labels,
            DatasetWithFrames(street, tuple(frames)),
            BuildOptions(sigma_px=LABEL_PX),
            poses=poses,
        )
    except SemvizError:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    truth = street.truth_map.elements
    row_of = {int(id_): row for row, id_ in enumerate(truth.id)}
    places, covariances = footprint_m(built.elements), footprint_covariance_m2(built.elements)
    true_places = footprint_m(truth)
    rows = []
    for place, source in enumerate(built.provenance):
        seen = [labels.observations[id_] for id_ in source.observation_ids]
        if not any(row.frame_index in inside for row in seen) or len(seen) < 4:
            continue
        size = 2 if built.elements.is_line[place] else 3
        if size == 2 and not (
            built.elements.anchor_known[place] and built.elements.end_known[place]
        ):
            continue  # the footprint is that of another part of the pole
        error = (places[place] - true_places[row_of[true_id[seen[0].id]]])[:size]
        covariance = covariances[place][:size, :size]
        rows.append((np.linalg.norm(error), error @ np.linalg.solve(covariance, error), size))
    table = np.array(rows).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def summary(found: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> str:
    error = np.concatenate([one[0] for one in found])
    squared, freedom = (np.concatenate([one[place] for one in found]) for place in (1, 2))
    if not len(error):
        return "- | - | -"
    middle = np.median(squared / chi2.median(freedom))
    return f"{np.median(error):.3f} | {squared.sum() / freedom.sum():.2f} | {middle:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(2010, 2016)))
    parser.add_argument("--tracks", type=Path, help="folder that keeps tracks")
    arguments = parser.parse_args()
    rows = defaultdict(lambda: {"given": [], "refined": []})
    for number, seed in enumerate(arguments.seeds):
        street = Street(seed, StreetOptions(FRAMES))
        drive = opened(street, f"street{seed}-{FRAMES}", arguments.tracks)
        drawn = label_street(careful(street, LABEL_PX, seed), range(FRAMES), memory=FRAMES)
        true_id = {id_: truth.element_id for id_, truth in drawn.truth.items()}
        planted_faults = [one for draw in range(DRAWS) for one in faults(drive, (number, draw))]
        for name, level, planted in planted_faults:
            check = check_drive(planted.frames, drive.motions, drive.rig)
            assert planted.first is not None
            assert planted.last is not None
            inside = set(range(planted.first, planted.last + 1))
            known = pose_covariance(check, wrong_frames(check))
            for poses, frames, information in (
                ("given", planted.frames, None),
                ("refined", repaired(check), known),
            ):
                result = errors(street, drawn.labels, true_id, frames, inside, information)
                rows[name, level][poses].append(result)
    print("| fault | poses | given: m | NEES | median | refined: m | NEES | median |")
    print("|---|---|---|---|---|---|---|---|")
    for (name, level), found in rows.items():
        word = "1 cm, 0.02 deg" if level else "exact"
        print(f"| {name} | {word} | {summary(found['given'])} | {summary(found['refined'])} |")


def faults(drive: Drive, draw: tuple[int, int]) -> list[tuple[str, int, PlantedFault]]:
    """Return the planted faults of single frames, and none at all, at both levels of noise."""
    planted = []
    for level, noise in enumerate(NOISE):
        rng = np.random.default_rng([*draw, level])
        frames = noisy(drive.frames, *noise, rng)
        planted.append(("none", level, PlantedFault(frames, 10, 19)))
        for name, (plant, _) in POSE_FAULTS.items():
            one = plant(frames, np.random.default_rng([*draw, level]))
            if one.first is not None:
                planted.append((name, level, one))
    return planted


if __name__ == "__main__":
    main()

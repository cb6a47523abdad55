"""Maps from detections on held-out streets, and poses in them: how many frames must agree.

    OMP_NUM_THREADS=1 python bench/own_maps.py [--noise paper] [--step 2] [--streets 20]

Streets of 24 frames with seeds from 30100 on, seen by the simulated detector, with occlusion and
false detections. Each map is from the detections of every ``--step``-th frame alone; the odd frames
are localized in it from their left detections, with GPS 5-10 m off, heading unknown, two seeds.

Columns: cameras; ``--min-frames``; elements of the maps, and those that stand on nothing; frames,
ok, within 1 m, ok but more than 1 m or 1 deg off; mean RTE of ok frames.
"""

import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from real_chain import SIDES, errors_of, localized

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_annotation.mapping.association.detection_tracks import TrackOptions
from semviz_annotation.mapping.build import build_map
from semviz_core.base.detector_model import NoiseName
from semviz_core.base.frame import Side
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.street import Street

FRAMES, FIRST_SEED = 24, 30_100


@dataclass(frozen=True)
class Options:
    noise: NoiseName = "paper"
    step: int = 2
    """Every which frame the map is built from; 1: the localized ones, too."""
    streets: int = 20
    min_frames: tuple[int, ...] = (4, 3, 2)


class Detected(NamedTuple):
    """What a simulated detector finds along a street."""

    found: Proposals
    element_of: dict[str, int]
    """Of each detection: an element of the street, or -1."""


def main(options: Options) -> None:
    counts: defaultdict[tuple[int, int], Counter[str]] = defaultdict(Counter)
    errors_m: defaultdict[tuple[int, int], list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(FIRST_SEED, FIRST_SEED + options.streets):
            path = Path(folder) / str(seed)
            workspace = Workspace.create_street(path, seed, range(FRAMES))
            detected = detect(workspace, seed, options.noise)
            save_proposals(detected.found, workspace.proposals_path)
            for sides in (SIDES[:1], SIDES):
                for least in options.min_frames:
                    key = len(sides), least
                    built = build(workspace, detected.found, sides, options.step, least)
                    save_map(built, workspace.map_path("own"))
                    counts[key] += elements(built, detected.element_of)
                    more, ok_m = poses(workspace)
                    counts[key] += more
                    errors_m[key] += ok_m
    print("cameras  min-frames  elements  false  frames   ok  within 1 m  wrong  RTE")
    for key, of in counts.items():
        print(
            f"{key[0]:7d}{key[1]:12d}{of['elements']:10d}{of['false']:7d}{of['frames']:8d}"
            f"{of['ok']:5d}{of['within'] / of['frames']:12.0%}{of['wrong']:7d}"
            f"{np.mean(errors_m[key]):7.3f} m"
        )


def detect(workspace: Workspace, seed: int, noise: NoiseName) -> Detected:
    """Return what the simulated detector finds in both images of all frames."""
    street = workspace.source
    assert isinstance(street, Street)
    detector = SimulatedDetector(street, noise, seed)
    element_of: dict[str, int] = {}
    rows: list[Proposal] = []
    for frame in street.frames:
        for side in SIDES:
            seen = detector.detect(frame.index, side)
            for row, element_id in enumerate(seen.element_id.tolist()):
                one = seen.observed[np.array([row])]
                found = as_proposals(
                    frame.index, side, one, street.rig.left, "simulated", street.triangle_center
                )
                element_of |= {proposal.id: element_id for proposal in found}
                rows += found
    return Detected(Proposals.of(rows), element_of)


def build(
    workspace: Workspace, found: Proposals, sides: tuple[Side, ...], step: int, min_frames: int
) -> SemanticMap:
    """Return the map of every ``step``-th frame from its detections alone."""
    rows = [row for row in found.rows() if row.side in sides]
    return build_map(
        Labels(triangle_center=found.triangle_center),
        workspace.source,
        frames=range(0, FRAMES, step),
        detections=Proposals.of(rows, found.processed),
        tracking=TrackOptions(min_frames=min_frames),
    )[0]


def elements(built: SemanticMap, element_of: dict[str, int]) -> Counter[str]:
    """Count the elements, and those most of whose detections are of nothing."""
    counts = Counter(elements=len(built))
    for origin in built.provenance:
        seen = Counter(element_of[row] for row in origin.observation_ids)
        counts["false"] += seen.most_common(1)[0][0] < 0
    return counts


def poses(workspace: Workspace) -> tuple[Counter[str], list[float]]:
    """Localize the odd frames; return counts, and the errors (m) of ok ones."""
    counts: Counter[str] = Counter()
    errors_m = []
    for result, truth in localized(workspace, range(1, FRAMES, 2), 2, None):
        off_m, off_deg = errors_of(result, truth)
        is_ok, is_near = result.status == "ok", off_m < 1.0
        counts += Counter(
            frames=1, ok=int(is_ok), within=int(is_near),
            wrong=int(is_ok and not (is_near and off_deg < 1.0)),
        )  # fmt: skip
        if is_ok:
            errors_m.append(off_m)
    return counts, errors_m


if __name__ == "__main__":
    main(tyro.cli(Options))

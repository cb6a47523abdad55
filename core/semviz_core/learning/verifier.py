"""The trained verifier: how likely each mode of a search is the right one; numpy only."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.learning.evidence import Evidence, Float32Array
from semviz_core.learning.verification import layer_sizes, log_odds
from semviz_core.learning.weights import Weights, load_trained, other_version
from semviz_core.solving.search import Modes

TASK = "verifier"


@dataclass(frozen=True, eq=False)
class ModeVerifier:
    """A network's weights, and the classes that it knows."""

    weights: Mapping[str, Float32Array]
    classes: ClassSet

    def verified(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
    ) -> tuple[Modes, FloatArray]:
        """The modes with the likeliest first, the others as they were; and ``probability``."""
        probability = self.probability(observed, submap, camera, prior, modes)
        if not len(probability):
            return modes, probability
        order = np.argsort(np.arange(len(probability)) != probability.argmax(), kind="stable")
        chosen = replace(
            modes,
            rotation=modes.rotation[order],
            translation=modes.translation[order],
            score=modes.score[order],
            match=modes.match[order],
            gain=modes.gain[order],
        )
        return chosen, probability[order]

    def probability(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
    ) -> FloatArray:
        """(b,) that each mode is within 1 m and 2 deg of the truth; what is missing to 1 is that
        none is."""
        evidence = Evidence.of(observed, submap, camera, prior, modes, self.classes)
        right, none = log_odds(
            self.weights,
            evidence.mode,
            evidence.weight,
            evidence.mapped,
            evidence.near,
            evidence.seen,
            np.ones(evidence.seen.shape[:2], dtype=np.float32),
        )
        odds = np.append(right, none).astype(np.float64)
        share = np.exp(odds - odds.max())
        probability = np.zeros(len(modes.score))
        probability[: len(right)] = share[:-1] / share.sum()
        return probability


def load_verifier(path: Path | None, classes: ClassSet) -> ModeVerifier:
    """The one that comes with semviz, if ``path`` is None. Raises SemvizError where it is missing
    or for something else."""
    return load_trained(TASK, path, classes, _built)


def _built(weights: Weights, classes: ClassSet, path: Path) -> ModeVerifier:
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (inputs, outputs) in layer_sizes(len(classes)).items():
        shapes[f"{name}.weight"] = outputs, inputs
        shapes[f"{name}.bias"] = (outputs,)
    if {name: one.shape for name, one in weights.tensors.items()} != shapes:
        raise other_version(TASK, path)
    return ModeVerifier(weights.tensors, classes)

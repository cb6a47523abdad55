"""Weights of a trained network, stored with their task in one safetensors file.

Loading checks the task, the network's version, that all numbers are finite, and the file's hash
against the model card beside it. A loaded network is cached as long as its file is unchanged.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from semviz_core.base.classes import ClassSet
from semviz_core.common import limits
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

if TYPE_CHECKING:
    from torch import nn

FORMAT = 1
SHIPPED = Path(__file__).parents[1] / "weights"
"""The folder of the shipped weights, each with its model card."""
_KEY = "semviz weights"
Trained = TypeVar("Trained")


@dataclass(frozen=True, eq=False)
class NetworkWeights:
    """The weights of a network, with the task and options it was trained for."""

    task: str
    options: dict[str, Any]
    """As ``TrainingTask.options``; ``classes`` holds the class names, in order."""
    tensors: dict[str, NDArray[np.float32]]
    """By state-dict name; float16 on disk."""

    def save(self, path: Path) -> None:
        """Replace ``path``. Raise SemvizError if that fails; the old file then stays."""
        metadata = {"format": FORMAT, "task": self.task, "options": self.options}
        halves = {name: tensor.astype(np.float16) for name, tensor in self.tensors.items()}
        content = safetensors.numpy.save(halves, metadata={_KEY: json.dumps(metadata)})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    def check(self, task: str, classes: ClassSet, path: Path) -> ClassSet:
        """Return those of ``classes`` that the network knows.

        Raise SemvizError if the weights are for another task, or for a class that is not there.
        """
        if self.task != task:
            raise SemvizError(f"{path}: weights of {self.task}; give those of {task}")
        known = {class_.name: class_ for class_ in classes}
        names = self.options["classes"]
        if not isinstance(names, list) or not set(names) <= known.keys():
            raise SemvizError(
                f"{path}: trained for the classes {', '.join(names)}, not for "
                f"{', '.join(known)}; train with your classes"
            )
        return ClassSet(tuple(known[name] for name in names))

    def load_into(self, network: "nn.Module", path: Path) -> None:
        """Load the weights into ``network``. Raise SemvizError if its layers differ."""
        import torch

        tensors = {name: torch.from_numpy(tensor) for name, tensor in self.tensors.items()}
        try:
            network.load_state_dict(tensors)
        except RuntimeError:
            raise version_error(self.task, path) from None


def version_error(task: str, path: Path) -> SemvizError:
    """Return the error for weights of another version of the network."""
    return SemvizError(f"{path}: weights of another version of {task}; train it again")


def shipped_weights(task: str) -> Path:
    """Return the path of a task's shipped weights."""
    return SHIPPED / f"{task}.safetensors"


def load_trained(
    task: str,
    path: Path | None,
    classes: ClassSet,
    build: Callable[[NetworkWeights, ClassSet, Path], Trained],
) -> Trained:
    """Return ``build(weights, known, path)``; default: the task's shipped weights.

    ``known`` are those of ``classes`` that the network was trained for; see ``as_known``. The
    result is cached as long as the file is unchanged, so ``build`` must be a module's function.
    Raise SemvizError if the weights are missing, for another task, or refused by ``build``.
    """
    path = path or shipped_weights(task)
    changed_ns = path.stat().st_mtime_ns if path.is_file() else 0
    trained: Trained = _built(task, path, changed_ns, classes, build)
    return trained


@lru_cache(maxsize=16)
def _built(
    task: str, path: Path, changed_ns: int, classes: ClassSet, build: Callable[..., Any]
) -> Any:
    weights = read_weights(path)
    return build(weights, weights.check(task, classes, path), path)


def _check_card(path: Path) -> None:
    """Raise SemvizError if the weights are not those of the model card beside them, if any."""
    card = path.with_suffix(".json")
    if not card.is_file():
        return
    try:
        recorded = limits.parsed_json(limits.read_limited(card, limits.MOST_SETTINGS_BYTES))[
            "sha256"
        ]
        is_sound = recorded == hashlib.sha256(path.read_bytes()).hexdigest()
    except (OSError, KeyError, TypeError, ValueError):
        is_sound = False
    if not is_sound:
        raise SemvizError(
            f"{path}: not the weights that their card {card.name} describes; one of the two is "
            "damaged: restore both, or run 'semviz weights' again"
        )


def read_weights(path: Path) -> NetworkWeights:
    """Read weights. Raise SemvizError if they are missing, damaged, or of another format."""
    if not path.is_file():
        raise SemvizError(f"{path}: no such weights; train a network, or name another file")
    limits.check_file(path, limits.MOST_TENSOR_BYTES)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = limits.parsed_json((file.metadata() or {})[_KEY])
            tensors = {
                name: file.get_tensor(name).astype(np.float32)
                for name in file.keys()  # noqa: SIM118
            }
        form, task, options = metadata["format"], metadata["task"], metadata["options"]
        if not all(isinstance(name, str) for name in [task, *options["classes"]]):
            raise ValueError("a name that is no text")
    except (OSError, SafetensorError, LookupError, TypeError, ValueError):
        raise SemvizError(f"{path}: not weights of semviz, or damaged; train again") from None
    if form != FORMAT:
        raise SemvizError(
            f"{path}: weights of format {limits.shown(form)}, this semviz reads {FORMAT}; use the "
            "version that wrote them, or train again"
        )
    _check_card(path)
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise SemvizError(f"{path}: holds numbers that are not finite; train again")
    return NetworkWeights(task, options, tensors)

"""Weights of a trained network: one safetensors file that says what they are of."""

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

from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError
from semviz_core.files import replacing

if TYPE_CHECKING:
    from torch import nn

FORMAT = 1
SHIPPED = Path(__file__).parents[1] / "weights"
"""The folder of the weights that come with semviz, each with its card beside it."""
_KEY = "semviz weights"
Trained = TypeVar("Trained")


@dataclass(frozen=True, eq=False)
class Weights:
    """What a network of a task knows."""

    task: str
    options: dict[str, Any]
    """As ``Task.options``; its ``classes`` are the names of the classes, in order."""
    tensors: dict[str, NDArray[np.float32]]
    """By torch's names; float16 on disk."""

    def save(self, path: Path) -> None:
        """Replace ``path``. Raises SemvizError where that fails; the former file then stays."""
        told = {"format": FORMAT, "task": self.task, "options": self.options}
        small = {name: one.astype(np.float16) for name, one in self.tensors.items()}
        content = safetensors.numpy.save(small, metadata={_KEY: json.dumps(told)})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    def check(self, task: str, classes: ClassSet, path: Path) -> None:
        """Raises SemvizError where they are for something else."""
        if self.task != task:
            raise SemvizError(f"{path}: weights of {self.task}; give those of {task}")
        names = [one.name for one in classes]
        if self.options["classes"] != names:
            raise SemvizError(
                f"{path}: trained for the classes {', '.join(self.options['classes'])}, not for "
                f"{', '.join(names)}: train it with yours"
            )

    def put_into(self, network: "nn.Module", path: Path) -> None:
        """Raises SemvizError where the network is built otherwise."""
        import torch

        tensors = {name: torch.from_numpy(one) for name, one in self.tensors.items()}
        try:
            network.load_state_dict(tensors)
        except RuntimeError:
            raise other_version(self.task, path) from None


def other_version(task: str, path: Path) -> SemvizError:
    """The error for weights whose network is not the one that this semviz has."""
    return SemvizError(f"{path}: weights of another version of {task}; train it again")


def shipped_weights(task: str) -> Path:
    """Where the weights are that come with semviz."""
    return SHIPPED / f"{task}.safetensors"


def load_trained(
    task: str,
    path: Path | None,
    classes: ClassSet,
    build: Callable[[Weights, ClassSet, Path], Trained],
) -> Trained:
    """What ``build`` makes of a task's weights at ``path``, or of those that come with semviz;
    made once for as long as the file stays as it is, so ``build`` is a function of a module.

    Raises SemvizError where there are none, they are for something else, or ``build`` refuses them.
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
    weights.check(task, classes, path)
    return build(weights, classes, path)


def read_weights(path: Path) -> Weights:
    """Raises SemvizError where they are missing, damaged, of another version, or not finite."""
    if not path.is_file():
        raise SemvizError(f"{path}: no such weights; train some, or name another file")
    try:
        with safe_open(path, framework="numpy") as file:
            told = json.loads((file.metadata() or {})[_KEY])
            tensors = {
                name: file.get_tensor(name).astype(np.float32)
                for name in file.keys()  # noqa: SIM118
            }
        form, task, options = told["format"], told["task"], told["options"]
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        raise SemvizError(f"{path}: no weights of semviz, or damaged") from None
    if form != FORMAT:
        raise SemvizError(
            f"{path}: weights of format {form}; this semviz has {FORMAT}: use the version that "
            "they were made with, or train again"
        )
    if not all(np.isfinite(one).all() for one in tensors.values()):
        raise SemvizError(f"{path}: holds numbers that are not finite; train it again")
    return Weights(task, options, tensors)

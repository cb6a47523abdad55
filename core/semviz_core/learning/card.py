"""The weights of a training, in a folder to be kept, with a card that says where they come from."""

import hashlib
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.learning.checkpoint import Checkpoint
from semviz_core.learning.learner import NETWORK
from semviz_core.learning.training import CHECKPOINT
from semviz_core.learning.weights import Weights

FORMAT = 1


def write_weights(training: Path, folder: Path) -> Path:
    """``folder``/TASK.safetensors and, beside it, its card TASK.json, of the last checkpoint.

    Raises SemvizError where ``training`` holds none, or the files cannot be written.
    """
    if not (training / CHECKPOINT).is_file():
        raise SemvizError(f"{training}: no training; 'semviz train' makes one with --out")
    checkpoint = Checkpoint.load(training / CHECKPOINT)
    identity = checkpoint.identity
    path = folder / f"{identity['task']}.safetensors"
    tensors = {
        name.removeprefix(NETWORK): value.numpy()
        for name, value in checkpoint.tensors.items()
        if name.startswith(NETWORK)
        and value.is_floating_point()  # counts of batches are no weights
    }
    Weights(identity["task"], identity["options"], tensors).save(path)
    card = {
        **_card(checkpoint),
        "parameters": sum(value.size for value in tensors.values()),
        "bytes": path.stat().st_size,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }
    with replacing(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(card, indent=2, ensure_ascii=False) + "\n")
    return path


def _card(checkpoint: Checkpoint) -> dict[str, Any]:
    """What a checkpoint says of itself: how it was trained, on what, and how good it is."""
    identity, course = checkpoint.identity, checkpoint.course
    return {
        "format": FORMAT,
        "semviz": version("semviz"),
        "task": identity["task"],
        "options": identity["options"],
        "seed": identity["seed"],
        "batch": identity["batch"],
        "samples": course.samples,
        "planned_samples": [list(plan) for plan in course.plans],
        "steps": course.samples // identity["batch"],
        "skipped_steps": course.skipped,
        "wall_s": round(sum(course.seconds.values()), 1),
        "machines": {name: round(seconds, 1) for name, seconds in course.seconds.items()},
        "held_out": course.held_out,
    }

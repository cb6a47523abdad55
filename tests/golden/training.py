"""G7: trainings that were stopped and gone on with: every number of the checkpoint."""

import json
from pathlib import Path
from typing import Any

from golden.canonical import digest, plain
from golden.command import run

ROADS = ("--batch", "60", "--held-out", "12", "--workers", "0")
CROPS = ("--batch", "6", "--streets", "1")
TRAININGS = {
    "paper": (("train", "paper", *ROADS), 240),
    "verifier": (("train", "verifier", *ROADS), 240),
    "detector": (("detect", "train", *CROPS), 24),
}
"""A command, and how many samples it is to see in all; the first stop is after one step."""
LEFT_OUT = frozenset({"semviz", "wall_s", "machines", "held_out"})
"""Of a card: the version; how long and where it was trained; and figures of held-out samples, which
are fewer where the machine is slow."""


def golden_values(folder: Path) -> dict[str, Any]:
    """Checkpoint, history and weights of each."""
    found: dict[str, Any] = {}
    for name, (command, samples) in TRAININGS.items():
        out = ("--out", name, "--samples", str(samples))
        stopped = run(folder, *command, *out, "--stop-after-s", "0")
        found[f"{name}, stopped"] = [stopped.status, _tensors(folder / name)]
        whole = run(folder, *command, *out)
        found[f"{name}, gone on with"] = [whole.status, _tensors(folder / name)]
        run(folder, "weights", name, "--out", "weights")
        found[f"{name}, weights"] = _tensors(folder / "weights", f"{name}.safetensors")
        found[f"{name}, card"] = _card(folder / "weights" / f"{name}.json")
    return found


def _tensors(folder: Path, pattern: str = "*.safetensors") -> dict[str, str]:
    """A hash of all tensors of a file by its name, and one of their names and types."""
    from safetensors.numpy import load_file

    found = {}
    for path in sorted(folder.glob(pattern)):
        tensors = load_file(path)
        found[path.name] = digest(dict(sorted(tensors.items())))
    return found


def _card(path: Path) -> dict[str, str]:
    card = json.loads(path.read_text())
    return {key: digest(plain(value)) for key, value in card.items() if key not in LEFT_OUT}

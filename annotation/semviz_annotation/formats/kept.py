"""What only another tool understands, kept beside the labels for the way back.

One JSON file an import, in the workspace's folder ``kept``; never changed once written. It holds
keys of labelme's files by image, and of its shapes by observation. What belongs to a deleted
observation stays, and counts again when the deletion is undone.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.sources.source import Side


@dataclass(frozen=True)
class Kept:
    """Keys and values as they were read."""

    images: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    observations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def made(
        cls,
        images: Mapping[tuple[Side, int], Mapping[str, Any]],
        observations: Mapping[str, Mapping[str, Any]],
    ) -> "Kept":
        named = {f"{side}/{frame}": one for (side, frame), one in images.items() if one}
        return cls(named, {key: one for key, one in observations.items() if one})

    def of_image(self, side: Side, frame_index: int) -> dict[str, Any]:
        return dict(self.images.get(f"{side}/{frame_index}", {}))

    def of_observation(self, observation_id: str) -> dict[str, Any]:
        return dict(self.observations.get(observation_id, {}))


def save_kept(kept: Kept, folder: Path) -> None:
    """Add a file to ``folder``; none where there is nothing to keep, or it is there already."""
    if not kept.images and not kept.observations:
        return
    text = json.dumps({"images": dict(kept.images), "observations": dict(kept.observations)})
    path = folder / f"labelme-{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"
    if not path.exists():
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def load_kept(folder: Path) -> Kept:
    """Everything in ``folder``, newest last; SemvizError where a file is broken."""
    images: dict[str, Mapping[str, Any]] = {}
    observations: dict[str, Mapping[str, Any]] = {}
    for path in sorted(
        folder.glob("labelme-*.json"), key=lambda one: (one.stat().st_mtime_ns, one)
    ):
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            images.update(document["images"])
            observations.update(document["observations"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise SemvizError(f"{path}: damaged; delete it, its keys are lost then") from None
    return Kept(images, observations)

"""What a sequence's cameras were when it was first worked with: kept, and compared later."""

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera, Rig
from semviz_core.pose import so3_log


@dataclass(frozen=True)
class Calibration:
    """A rig in numbers, rounded to what no label can tell: how it is written into a workspace."""

    hash: str
    """Of all the rest."""
    left_size_px: tuple[int, int]
    left_intrinsics_px: tuple[float, float, float, float, float]
    """fx, fy, cx, cy, skew."""
    left_distortion: tuple[float, ...]
    right_size_px: tuple[int, int] | None = None
    right_intrinsics_px: tuple[float, float, float, float, float] | None = None
    right_distortion: tuple[float, ...] | None = None
    right_position_m: tuple[float, float, float] | None = None
    """Of the right camera, in the left one's axes."""
    right_rotation_rad: tuple[float, float, float] | None = None
    """Axis-angle, from the right camera's axes to the left one's."""

    @classmethod
    def of(cls, rig: Rig) -> "Calibration":
        numbers = _camera_numbers("left", rig.left)
        if rig.right is not None and rig.T_right_left is not None:
            T_left_right = rig.T_right_left.inverse()
            numbers |= _camera_numbers("right", rig.right)
            numbers["right_position_m"] = _rounded(T_left_right.translation, 4)
            numbers["right_rotation_rad"] = _rounded(so3_log(T_left_right.rotation), 5)
        text = json.dumps(numbers, sort_keys=True)
        return cls(hash=hashlib.sha256(text.encode()).hexdigest()[:16], **numbers)

    def differences(self, new: "Calibration") -> tuple[str, ...]:
        """What is another number in ``new``, for people: ``focal length 718.9 -> 720.0 px``."""
        if self.right_size_px is None and new.right_size_px is not None:
            return ("there was no right camera",)
        if self.right_size_px is not None and new.right_size_px is None:
            return ("the right camera is gone",)
        found: dict[str, None] = {}  # in order, each once: both cameras may have changed alike
        before, after = asdict(self), asdict(new)
        for one in fields(self):
            if one.name != "hash" and before[one.name] != after[one.name]:
                found |= dict.fromkeys(_difference(one.name, before[one.name], after[one.name]))
        return tuple(found)


def _camera_numbers(side: str, camera: Camera) -> dict[str, Any]:
    K = camera.K
    lengths = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]])
    return {
        f"{side}_size_px": (camera.width, camera.height),
        f"{side}_intrinsics_px": _rounded(lengths, 3),
        f"{side}_distortion": _rounded(camera.distortion, 6),
    }


def _rounded(values: FloatArray, digits: int) -> tuple[float, ...]:
    return tuple(round(float(value), digits) + 0.0 for value in values)  # no -0.0


def _difference(name: str, old: tuple[float, ...], new: tuple[float, ...]) -> list[str]:
    """A field's difference in words."""
    side, what = name.split("_", 1)
    match what:
        case "size_px":
            return [f"{side} images {old[0]}x{old[1]} -> {new[0]}x{new[1]} px"]
        case "intrinsics_px":
            parts = {
                "focal length": (old[:2], new[:2]),
                "principal point": (old[2:4], new[2:4]),
                "skew": (old[4:], new[4:]),
            }
            return [
                f"{part} {_words(one)} -> {_words(two)} px"
                for part, (one, two) in parts.items()
                if one != two
            ]
        case "position_m":
            if old[0] != new[0]:
                return [f"baseline {old[0]:.4f} -> {new[0]:.4f} m"]
            return [f"position of the right camera {_words(old)} -> {_words(new)} m"]
        case "rotation_rad":
            angles = (np.rad2deg(np.linalg.norm(one)) for one in (old, new))
            return [f"rotation of the right camera {next(angles):.3f} -> {next(angles):.3f} deg"]
    return [f"{side} distortion {_words(old)} -> {_words(new)}"]


def _words(values: tuple[float, ...]) -> str:
    """One number where all are the same."""
    distinct = values[:1] if len(set(values)) == 1 else values
    return ", ".join(f"{value:g}" for value in distinct) or "none"

"""Debug visual localization in sparse semantic maps of poles and traffic signs.

Public names are loaded on first use: ``import semviz`` itself imports nothing heavy.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semviz.runs.reader import load_run
    from semviz.runs.recorder import MatchedPose, RunRecorder
    from semviz.workspace.workspace import Workspace
    from semviz_core.base.camera import Camera, Rig
    from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, ElementClass
    from semviz_core.base.detector_model import DetectorModel
    from semviz_core.base.elements import Elements2D, Elements3D
    from semviz_core.base.frame import Belief, Frame, Odometry, OdometryNoise, Prior
    from semviz_core.base.localization import Localization
    from semviz_core.base.map_file import load_map, save_map
    from semviz_core.base.pose import Pose
    from semviz_core.base.semantic_map import MapFrame, SemanticMap
    from semviz_core.common.errors import SemvizError
    from semviz_core.datasets.kitti import KittiSequence
    from semviz_core.localization.association import PairConstraints
    from semviz_core.localization.camera_views import BodyMotion, CameraView, rolling_shutter
    from semviz_core.localization.localizer import Localizer
    from semviz_core.localization.matched import localize_matches
    from semviz_core.localization.matched.matches import Estimate
    from semviz_core.localization.noise_estimate import NoiseEstimate
    from semviz_core.localization.refinement import Failure
    from semviz_core.localization.rig import localize_rig
    from semviz_core.simulation.street import Street
    from semviz_core.tracking.tracker import TrackedPose, Tracker

    __version__: str

_HOMES = {
    "Belief": "semviz_core.base.frame",
    "Camera": "semviz_core.base.camera",
    "CameraView": "semviz_core.localization.camera_views",
    "ClassSet": "semviz_core.base.classes",
    "DEFAULT_CLASSES": "semviz_core.base.classes",
    "DetectorModel": "semviz_core.base.detector_model",
    "ElementClass": "semviz_core.base.classes",
    "Elements2D": "semviz_core.base.elements",
    "Elements3D": "semviz_core.base.elements",
    "Estimate": "semviz_core.localization.matched.matches",
    "Failure": "semviz_core.localization.refinement",
    "Frame": "semviz_core.base.frame",
    "KittiSequence": "semviz_core.datasets.kitti",
    "Localization": "semviz_core.base.localization",
    "Localizer": "semviz_core.localization.localizer",
    "MapFrame": "semviz_core.base.semantic_map",
    "MatchedPose": "semviz.runs.recorder",
    "BodyMotion": "semviz_core.localization.camera_views",
    "NoiseEstimate": "semviz_core.localization.noise_estimate",
    "Odometry": "semviz_core.base.frame",
    "OdometryNoise": "semviz_core.base.frame",
    "PairConstraints": "semviz_core.localization.association",
    "Pose": "semviz_core.base.pose",
    "Prior": "semviz_core.base.frame",
    "Rig": "semviz_core.base.camera",
    "RunRecorder": "semviz.runs.recorder",
    "SemanticMap": "semviz_core.base.semantic_map",
    "SemvizError": "semviz_core.common.errors",
    "Street": "semviz_core.simulation.street",
    "TrackedPose": "semviz_core.tracking.tracker",
    "Tracker": "semviz_core.tracking.tracker",
    "Workspace": "semviz.workspace.workspace",
    "load_map": "semviz_core.base.map_file",
    "load_run": "semviz.runs.reader",
    "localize_matches": "semviz_core.localization.matched",
    "localize_rig": "semviz_core.localization.rig",
    "rolling_shutter": "semviz_core.localization.camera_views",
    "save_map": "semviz_core.base.map_file",
}

_FORMER = {"Pairing": "PairConstraints", "Track": "TrackedPose"}
"""Names of version 0.1.0, kept for one release."""

__all__ = [
    "DEFAULT_CLASSES",
    "Belief",
    "BodyMotion",
    "Camera",
    "CameraView",
    "ClassSet",
    "DetectorModel",
    "ElementClass",
    "Elements2D",
    "Elements3D",
    "Estimate",
    "Failure",
    "Frame",
    "KittiSequence",
    "Localization",
    "Localizer",
    "MapFrame",
    "MatchedPose",
    "NoiseEstimate",
    "Odometry",
    "OdometryNoise",
    "PairConstraints",
    "Pose",
    "Prior",
    "Rig",
    "RunRecorder",
    "SemanticMap",
    "SemvizError",
    "Street",
    "TrackedPose",
    "Tracker",
    "Workspace",
    "__version__",
    "load_map",
    "load_run",
    "localize_matches",
    "localize_rig",
    "rolling_shutter",
    "save_map",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("semviz")
    name = _FORMER.get(name, name)
    if name not in _HOMES:
        raise AttributeError(f"module 'semviz' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__

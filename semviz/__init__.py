"""See and mend visual localization in sparse semantic maps of poles and traffic signs.

The public names are loaded when first used: ``import semviz`` itself imports nothing heavy.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semviz.recording.reader import load_run
    from semviz.workspace import Workspace
    from semviz_core.camera import Camera, Rig
    from semviz_core.classes import DEFAULT_CLASSES, ClassSet, ElementClass
    from semviz_core.detector_model import DetectorModel
    from semviz_core.elements import Elements2D, Elements3D
    from semviz_core.errors import SemvizError
    from semviz_core.frame import Belief, Frame, Prior
    from semviz_core.localization import Localization
    from semviz_core.localize import Localizer
    from semviz_core.map_file import load_map, save_map
    from semviz_core.pose import Pose
    from semviz_core.semantic_map import MapFrame, SemanticMap
    from semviz_core.sequence.odometry import Odometry, OdometryNoise
    from semviz_core.sequence.tracker import Track, Tracker
    from semviz_core.solving.matched import localize_matches
    from semviz_core.solving.matched.matches import Estimate
    from semviz_core.solving.pairing import Pairing
    from semviz_core.solving.refine import Failure
    from semviz_core.sources.kitti import KittiSequence
    from semviz_core.sources.street.street import Street

    __version__: str

_HOMES = {
    "Belief": "semviz_core.frame",
    "Camera": "semviz_core.camera",
    "ClassSet": "semviz_core.classes",
    "DEFAULT_CLASSES": "semviz_core.classes",
    "DetectorModel": "semviz_core.detector_model",
    "ElementClass": "semviz_core.classes",
    "Elements2D": "semviz_core.elements",
    "Elements3D": "semviz_core.elements",
    "Estimate": "semviz_core.solving.matched.matches",
    "Failure": "semviz_core.solving.refine",
    "Frame": "semviz_core.frame",
    "KittiSequence": "semviz_core.sources.kitti",
    "Localization": "semviz_core.localization",
    "Localizer": "semviz_core.localize",
    "MapFrame": "semviz_core.semantic_map",
    "Odometry": "semviz_core.sequence.odometry",
    "OdometryNoise": "semviz_core.sequence.odometry",
    "Pairing": "semviz_core.solving.pairing",
    "Pose": "semviz_core.pose",
    "Prior": "semviz_core.frame",
    "Rig": "semviz_core.camera",
    "SemanticMap": "semviz_core.semantic_map",
    "SemvizError": "semviz_core.errors",
    "Street": "semviz_core.sources.street.street",
    "Track": "semviz_core.sequence.tracker",
    "Tracker": "semviz_core.sequence.tracker",
    "Workspace": "semviz.workspace",
    "load_map": "semviz_core.map_file",
    "load_run": "semviz.recording.reader",
    "localize_matches": "semviz_core.solving.matched",
    "save_map": "semviz_core.map_file",
}

__all__ = [
    "DEFAULT_CLASSES",
    "Belief",
    "Camera",
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
    "Odometry",
    "OdometryNoise",
    "Pairing",
    "Pose",
    "Prior",
    "Rig",
    "SemanticMap",
    "SemvizError",
    "Street",
    "Track",
    "Tracker",
    "Workspace",
    "__version__",
    "load_map",
    "load_run",
    "localize_matches",
    "save_map",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("semviz")
    if name not in _HOMES:
        raise AttributeError(f"module 'semviz' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__

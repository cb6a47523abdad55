"""How labels become a map: the settings, and how a map remembers them."""

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np

from semviz_annotation.mapping.paper import PaperOptions
from semviz_annotation.mapping.placing.least_squares import PlaceOptions
from semviz_annotation.mapping.placing.refine import RefineOptions
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class BuildOptions:
    """Settings of the method that places and links all views together."""

    sigma_px: float = 1.0
    """How well labels are placed, in each direction: 1 for people, 2 to 4 for detectors."""
    min_angle_deg: float = 0.5
    """Things whose rays are all nearer to parallel are left out: by stereo alone, with KITTI's
    baseline, from 62 m on, where 1 px is 10 m."""
    pose_sigma_m: float = 0.05
    """How far poses may be off, in each direction, from one pass to the next. KITTI 02 shows about
    as much within one: 1 px at 30 m. For linking, and for telling misplaced labels."""
    min_frames: int = 1
    """What fewer frames show is left out. People draw no noise; with a detector, 2 or 3."""
    refine: RefineOptions | None = None
    """Priors of the frames' poses, to move these too; None keeps them."""

    @property
    def place(self) -> PlaceOptions:
        return PlaceOptions(self.sigma_px, float(np.deg2rad(self.min_angle_deg)))


Options: TypeAlias = BuildOptions | PaperOptions
AS_USUAL = BuildOptions()


def settings_of(options: Options, frames: Collection[int] | None) -> dict[str, Any]:
    """JSON values from which ``options_of`` gets options and frames back."""
    method = "paper" if isinstance(options, PaperOptions) else "joint"
    chosen = None if frames is None else sorted(frames)
    return {"method": method, "frames": chosen, **asdict(options)}


def options_of(settings: Mapping[str, Any]) -> tuple[Options, Collection[int] | None]:
    """Options and frames of a map's ``settings``; SemvizError where it was not built from labels,
    or by another version of semviz."""
    given = dict(settings)
    method, frames = given.pop("method", None), given.pop("frames", None)
    try:
        if method == "paper":
            return PaperOptions(**given), frames
        if method == "joint":
            given["refine"] = _refine_options(given["refine"])
            return BuildOptions(**given), frames
    except (KeyError, TypeError, ValueError):
        raise SemvizError(
            "this map was built by another version of semviz; run 'semviz map build'"
        ) from None
    raise SemvizError("this map does not say how it was built; run 'semviz map build'")


def _refine_options(given: Mapping[str, Any] | None) -> RefineOptions | None:
    if given is None:
        return None
    return RefineOptions(**(dict(given) | {"place": PlaceOptions(**given["place"])}))

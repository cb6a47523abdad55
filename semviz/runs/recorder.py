"""Record the frames of any localizer as a run, for diagnosis, inspector, comparison and report.

A frame is a ``Localization`` of semviz, or the pose and the matches of another localizer.
"""

from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semviz.runs.images import jpeg
from semviz.runs.run import FrameRecord, RunInfo, assumed_detector
from semviz.runs.writer import RunWriter, unfinished_run
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.detector_model import SHIPPED_DETECTOR, DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Frame, Prior
from semviz_core.base.localization import Localization, Match, Refinement, Status
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray, float_array, int_array
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import UNKNOWN_ID
from semviz_core.localization.residuals import pair_residuals

CROP_M = 120.0
"""Radius of the submap of frames that are recorded without one."""


@dataclass(frozen=True, eq=False)
class MatchedPose:
    """What a localizer other than semviz's returned for one frame."""

    observed: Elements2D
    """Detections or keypoints (m) that were matched."""
    T_camera_map: Pose | None
    """None: it found no pose."""
    matches: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """(k, 2) row of ``observed`` and id of the map element, best first."""
    score: FloatArray | None = None
    """(k,) probability of each match; None: 1."""
    covariance: FloatArray | None = None
    """(6, 6) of the left perturbation of T_camera_map, if it is known."""
    status: Status | None = None
    """None: ``ok`` with a pose, else ``cannot``."""
    reason: str = ""
    """One sentence; empty: how many matches fit."""
    prior: Prior | None = None
    """What was known before the image was used, if anything."""
    submap: Elements3D | None = None
    """The mapped elements that were searched; None: those around the pose, or else the prior."""
    time_ms: Mapping[str, float] = field(default_factory=dict)
    """Wall time of each stage."""

    def __post_init__(self) -> None:
        matches = int_array(np.reshape(self.matches, (-1, 2)), (None, 2), "matches")
        rows = matches[:, 0]
        if len(rows) and not (rows.min() >= 0 and rows.max() < len(self.observed)):
            raise SemvizError(
                f"matches name row {rows.max()} of {len(self.observed)} observed elements; give "
                "(row of observed, id of the map element)"
            )
        object.__setattr__(self, "matches", matches)
        if self.score is not None:
            object.__setattr__(self, "score", float_array(self.score, (len(matches),), "score"))
        if self.covariance is not None:
            covariance = float_array(self.covariance, (6, 6), "covariance")
            object.__setattr__(self, "covariance", covariance)

    def localization(
        self,
        method: str,
        camera: Camera,
        semantic_map: SemanticMap,
        detector: DetectorModel = SHIPPED_DETECTOR,
    ) -> Localization:
        """Return it as a localization in a map. Raise SemvizError if a match is not in the map."""
        submap = self._submap(semantic_map)
        pairs = self._pairs(submap)
        pose, fit = self.T_camera_map, None
        if pose is not None:
            first = _first_of_each(pairs)
            fit = fitted_pairs(pose, camera, self.observed, submap, first, detector)
        status: Status = self.status or ("cannot" if pose is None else "ok")
        if (status == "cannot") != (pose is None):
            raise SemvizError(f"status '{status}' does not go with {'no' if pose is None else 'a'} "
                              "pose: 'cannot' has none")  # fmt: skip
        return Localization(
            method,
            camera,
            self.prior,
            self.observed,
            submap,
            status,
            self.reason or _default_reason(fit),
            pose,
            self.covariance,
            _match(pairs, self.score, len(self.observed), len(submap)) if len(pairs) else None,
            refinement=fit,
            time_ms=dict(self.time_ms),
        )

    def _submap(self, semantic_map: SemanticMap) -> Elements3D:
        """Return the submap, with all matched elements."""
        if self.submap is not None:
            return self.submap
        elements = semantic_map.elements
        around = None if self.prior is None else self.prior.position_m
        if self.T_camera_map is not None:
            around = self.T_camera_map.inverse().translation
        near = np.zeros(len(elements), dtype=bool)
        if around is not None:
            near = np.linalg.norm(elements.anchor_m[:, :2] - around[:2], axis=1) <= CROP_M
        return elements[near | np.isin(elements.id, self.matches[:, 1])]

    def _pairs(self, submap: Elements3D) -> IntArray:
        """Return (k, 2) rows of observed and submap."""
        row_of = {int(id_): row for row, id_ in enumerate(submap.id)}
        unknown = [id_ for id_ in self.matches[:, 1].tolist() if id_ not in row_of]
        if unknown:
            raise SemvizError(
                f"matches name element {unknown[0]}, which is not in the map or submap; give ids "
                "of map elements"
            )
        pairs = [(row, row_of[id_]) for row, id_ in self.matches.tolist()]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def fitted_pairs(
    T_camera_map: Pose,
    camera: Camera,
    observed: Elements2D,
    submap: Elements3D,
    pairs: IntArray,
    detector: DetectorModel,
) -> Refinement:
    """Return one-to-one pairs (k, 2) and their residuals at a pose; nothing is iterated."""
    residuals = pair_residuals(T_camera_map, camera, observed, submap, pairs, detector)
    cost = np.array([np.minimum(residuals.chi2, 1e9).sum()])
    return Refinement(pairs, residuals.residual_px, residuals.chi2, residuals.inlier, cost)


def _first_of_each(pairs: IntArray) -> IntArray:
    """Return the pairs whose observed and mapped elements are in no earlier pair."""
    kept: list[tuple[int, int]] = []
    used: tuple[set[int], set[int]] = set(), set()
    for i, j in pairs.tolist():
        if i not in used[0] and j not in used[1]:
            kept.append((i, j))
            used[0].add(i)
            used[1].add(j)
    return np.array(kept, dtype=np.int64).reshape(-1, 2)


def _match(pairs: IntArray, score: FloatArray | None, m: int, n: int) -> Match:
    """Return the matrix of probabilities: rows and columns sum to 1 with their dustbins."""
    given = np.zeros((m, n))
    given[pairs[:, 0], pairs[:, 1]] = 1.0 if score is None else np.clip(score, 0.0, 1.0)
    most = np.maximum(given.sum(axis=1)[:, None], given.sum(axis=0)[None])
    probability = np.zeros((m + 1, n + 1))
    probability[:m, :n] = given / np.maximum(most, 1.0)
    probability[:m, n] = 1.0 - probability[:m, :n].sum(axis=1)
    probability[m, :n] = 1.0 - probability[:m, :n].sum(axis=0)
    cost = np.full((m, n), np.inf)
    cost[pairs[:, 0], pairs[:, 1]] = 1.0 - given[pairs[:, 0], pairs[:, 1]]
    return Match(cost, probability, pairs)


def _default_reason(fit: Refinement | None) -> str:
    if fit is None:
        return "The localizer returned no pose."
    return f"{int(fit.inlier.sum())} of {len(fit.pairs)} matches fit the pose."


class RunRecorder:
    """Writes a run frame by frame: ``with RunRecorder(...) as recorder: recorder.add(...)``.

    Each frame is on disk when ``add`` returns. Until the block ends, and if it ends by an
    exception, the run is ``NAME.partial.rrd``.
    """

    def __init__(
        self,
        path: Path | str,
        semantic_map: SemanticMap,
        camera: Camera | Rig,
        method: str,
        *,
        workspace: Path | str = "",
        map_name: str = "",
        observations: str = "elsewhere",
        options: Mapping[str, Any] | None = None,
        images: bool = False,
    ) -> None:
        """Prepare a run of ``method``, a name for people.

        ``workspace`` lets the inspector open its labels. ``observations`` says where the observed
        elements are from, ``options`` (JSON values) how the method was set. With ``images``, each
        frame has one.
        """
        self._path, self._map = Path(path), semantic_map
        self.has_images = images
        if self._path.suffix != ".rrd":
            raise SemvizError(f"{path}: name a file that ends in .rrd, for example hloc.rrd")
        self._rig = camera if isinstance(camera, Rig) else Rig(camera)
        self._info = RunInfo(
            name=self._path.stem,
            workspace=str(workspace),
            method=method,
            seed=0,
            version=version("semviz"),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            rig=self._rig,
            map_name=map_name,
            observations=f"detected {observations}",
            options=dict(options or {}),
            images="embedded" if images else "none",
        )
        self._closing = ExitStack()
        self._writer: RunWriter | None = None
        self._last = -1
        self.statuses: Counter[str] = Counter()
        """Number of frames with each status."""

    def __enter__(self) -> "RunRecorder":
        opened = unfinished_run(self._path, self._info, self._map)
        self._writer = self._closing.enter_context(opened)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closing.__exit__(kind, error, trace)
        self._writer = None

    def add(
        self,
        index: int,
        found: Localization | MatchedPose,
        *,
        time_s: float | None = None,
        truth: Pose | None = None,
        element_id: ArrayLike | None = None,
        image: ByteImage | bytes | None = None,
    ) -> Localization:
        """Record a frame, and return it as a localization. Frames come in order of ``index``.

        ``truth`` is T_map_camera, ``element_id`` (m,) the true map element of each observed one
        (-1: false, -2: unknown). ``image`` is (height, width, 3) uint8 RGB, or a JPEG file's
        bytes. Raise SemvizError if something does not fit together.
        """
        if self._writer is None:
            raise SemvizError("the run is not open: write 'with RunRecorder(...) as recorder'")
        if index <= self._last:
            raise SemvizError(f"frame {index} comes after frame {self._last}; record them in order")
        if self.has_images != (image is not None):
            remedy = "give image=" if self.has_images else "open the recorder with images=True"
            raise SemvizError(f"frame {index}: {remedy}, for all frames or for none")
        result = found
        if isinstance(found, MatchedPose):
            result = found.localization(
                self._info.method, self._rig.left, self._map, assumed_detector(self._info)
            )
        assert isinstance(result, Localization)
        ids = np.full(len(result.observed), UNKNOWN_ID) if element_id is None else element_id
        frame = Frame(index, float(index) if time_s is None else float(time_s), truth)
        record = FrameRecord(frame, result, int_array(ids, (None,), "element_id"))
        self._writer.write(replace(record, image=self._jpeg(image)))
        self._last = index
        self.statuses[result.status] += 1
        return result

    def _jpeg(self, image: ByteImage | bytes | None) -> bytes | None:
        if image is None or isinstance(image, bytes):
            return image
        expected = (self._rig.left.height, self._rig.left.width, 3)
        if image.shape != expected:
            raise SemvizError(f"image: shape {image.shape}, expected {expected} as the camera has")
        return jpeg(image)

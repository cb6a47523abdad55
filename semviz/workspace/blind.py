"""Frames that one person labels without seeing another's labels: images and poses of a workspace,
and a label file of their own in ``WORKSPACE/blind/NAME``.

The person sees nothing of the workspace's labels there, so nothing has to be hidden. The file stays
when the frames are merged.
"""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from semviz.workspace.outputs import checked_name
from semviz.workspace.poses.pose_choices import PoseChoices
from semviz.workspace.workspace import BLIND, Workspace
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, FileDataset
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import DatasetWithFrames

if TYPE_CHECKING:
    from semviz_annotation.storage.store import LabelStore


def blind_workspace(outer: Workspace, name: str) -> "BlindWorkspace":
    """Return the frames that a person labels blind; make the folder of their labels if needed.

    Raise SemvizError if no folder can have this name.
    """
    for folder in ("maps", "runs"):
        (outer.path / BLIND / checked_name(name) / folder).mkdir(parents=True, exist_ok=True)
    return BlindWorkspace(outer, name)


class BlindWorkspace(Workspace):
    """The frames of ``outer`` that person ``name`` labels blind; all if that has ended.

    Raise SemvizError if there is no folder of their labels.
    """

    def __init__(self, outer: Workspace, name: str) -> None:
        if not (outer.path / BLIND / name).is_dir():
            raise SemvizError(f"{outer.path}: {name} labels no frames blind")
        settings = outer.settings.model_copy(update={"name": f"{outer.name}, blind"})
        super().__init__(outer.path / BLIND / name, settings)
        self.outer = outer
        self.person = name

    @cached_property
    def source(self) -> Dataset:
        whole = self.outer.source
        with self.outer.open_labels() as store:
            shares = store.team().shares
        wanted = {i for share in shares if self.person in share.people for i in share.frames}
        frames = tuple(frame for frame in whole.frames if frame.index in wanted) or whole.frames
        if isinstance(whole, FileDataset):
            return whole.with_frames(frames)
        return DatasetWithFrames(whole, frames)

    @cached_property
    def given_source(self) -> Dataset:
        return self.outer.given_source

    def pose_choices(self) -> PoseChoices:
        return self.outer.pose_choices()

    @property
    def pose_choices_path(self) -> Path:
        return self.outer.pose_choices_path

    @property
    def proposals_path(self) -> Path:
        return self.outer.proposals_path

    def open_labels(self) -> "LabelStore":
        """Open the person's label file, with the classes and attributes of the workspace's."""
        from semviz_annotation.labels.own_classes import CopyDeclarations
        from semviz_annotation.storage.store import LabelStore

        labels = self.outer.read_labels()
        classes, types = labels.own_classes.values(), labels.attribute_types.values()
        store = LabelStore.open(self.labels_path, self.source.rig, labels.triangle_center)
        try:
            copy = CopyDeclarations((*classes, *types))
            if list(copy.changes(store.labels, store.rules)):
                store.apply(copy, self.person, origin="machine")
        except BaseException:
            store.close()
            raise
        return store

    def _keep_calibration(self, rig: Rig) -> None:
        """The outer workspace keeps it."""

"""What was decided for a run's map, and the answers that people give in the run's workspace."""

from pathlib import Path

import numpy as np

from semviz.author import login_name
from semviz.recording.run import Run
from semviz.reviewing import Json, entry_json, entry_key
from semviz.workspace import SETTINGS, Workspace
from semviz_annotation.labels import Labels
from semviz_annotation.mapping.review import edit_of
from semviz_annotation.storing.store import LabelStore
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import Decision


class Decisions:
    """The decisions of one run's map. Labels are read anew each time: others may write them too."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is where the run was read from."""
        self._run = run
        self._map = run.semantic_map
        self._by_key = {entry_key(one): one for one in self._map.decisions}
        self._workspace = _workspace_of(run, path)
        self._answered: dict[str, int] = {}
        """Number of the operation that answered a decision here, by its key."""

    def view(self) -> Json:
        """All decisions, and where they can be answered."""
        labels = Labels() if self._workspace is None else self._workspace.read_labels()
        entries = [entry_json(one, self._map, labels) for one in self._by_key.values()]
        for one in entries:
            one["undo"] = one["key"] in self._answered
        return {"entries": entries, "note": self._note()}

    def answer(self, key: str, name: str) -> None:
        """Stores what a person says to a decision; SemvizError where that is not possible."""
        decision = self._decision(key)
        with self._open_labels() as store:
            edit = edit_of(decision, name, store.labels)
            self._answered[key] = store.apply(edit, login_name()).number

    def undo(self, key: str) -> None:
        """Takes the answer back that was given here."""
        if key not in self._answered:
            raise SemvizError("this decision was not answered here; 'semviz annotate' can undo it")
        with self._open_labels() as store:
            store.undo(login_name(), number=self._answered[key])
        del self._answered[key]

    def place(self, key: str) -> tuple[int | None, int | None]:
        """Position in the run of the frame that shows a decision best, and its map element.

        That is the frame nearest to the middle of those in which it is seen, or else near.
        """
        labels = entry_json(self._decision(key), self._map, Labels())["elements"]
        map_id = next((one["map_id"] for one in labels if one["map_id"] is not None), None)
        if map_id is None:
            return None, None
        frames = self._run.frames
        seen = [at for at, one in enumerate(frames) if np.any(one.element_id == map_id)]
        near = [at for at, one in enumerate(frames) if np.any(one.localization.submap.id == map_id)]
        there = seen or near
        return (there[len(there) // 2] if there else None), map_id

    def _decision(self, key: str) -> Decision:
        if key not in self._by_key:
            raise SemvizError("the map of this run has no such decision; reload the page")
        return self._by_key[key]

    def _open_labels(self) -> LabelStore:
        if self._workspace is None:
            raise SemvizError(self._note())
        return LabelStore.open(self._workspace.labels_path, self._workspace.classes)

    def _note(self) -> str:
        """Where answers go."""
        if self._workspace is not None:
            return f"Answers are saved in {self._workspace.name}; 'semviz map build' follows them."
        where = self._run.info.workspace or "WORKSPACE"
        return f"The labels are not at hand: answer in 'semviz annotate {where}'."


def _workspace_of(run: Run, path: Path) -> Workspace | None:
    """The workspace that a run lies in, or else the one it names, if the labels are of its map."""
    told = [Path(run.info.workspace)] if run.info.workspace else []
    for folder in (path.resolve().parent.parent, *told):
        if not (folder / SETTINGS).is_file():
            continue
        workspace = Workspace.open(folder)
        known = workspace.read_labels().elements
        ids = {one for decision in run.semantic_map.decisions for one in decision.label_ids}
        if ids & known.keys():
            return workspace
    return None

"""A workspace with the map of a street, and runs of passes between which the street changes."""

from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from changing_street import ChangingStreet, drive
from small_runs import saved

from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.workspace.workspace import Workspace
from semviz_core.base.map_file import save_map
from semviz_core.diagnosis.fault import UNKNOWN_ID
from semviz_core.simulation.street import Painter

FIRST_S = datetime(2026, 3, 3, 9, tzinfo=UTC).timestamp()
EVERY_S = 9.0 * 86400.0


def changing_workspace(
    folder: Path, changes: int = 2, passes: int = 7, hidden: float = 0.05, images: bool = False
) -> tuple[Workspace, list[Path], ChangingStreet]:
    """The workspace ``town`` of street 5 in a folder; two poles vanish, a sign appears and a pole
    moves before the pass ``changes``. Passes are nine days apart."""
    workspace = Workspace.create_street(folder / "town", seed=5)
    street = workspace.street
    still = ChangingStreet(street, {}, {}, {}, {})
    elements = street.truth_map.elements
    shown = [id_ for id_ in elements.id.tolist() if still.is_shown(id_)]
    poles = [id_ for id_ in shown if elements.is_line[elements.id == id_][0]]
    sign = max((id_ for id_ in shown if id_ not in poles), key=still.frames_that_show)
    vanishes, moves = dict.fromkeys((poles[0], poles[5]), changes), {poles[3]: changes}
    offset_m = {poles[3]: np.array([0.9, -1.2, 0.0])}
    world = ChangingStreet(street, vanishes, {sign: changes}, moves, offset_m)
    save_map(world.first_map, workspace.map_path("main"))
    info = RunInfo("", "", "search", 0, "0", "2026-01-01T00:00:00", street.rig, "main")
    runs = []
    for number in range(passes):
        one, start_s = drive(world, number, hidden_share=hidden), FIRST_S + number * EVERY_S
        records = tuple(
            FrameRecord(
                replace(frame, time_s=start_s + frame.time_s),
                result,
                np.full(len(result.observed), UNKNOWN_ID),
                _painted(world, number, frame.index) if images else None,
            )
            for frame, result in zip(one.frames, one.localizations, strict=True)
        )
        run = Run(replace(info, name=f"pass-{number + 1}"), world.first_map, records)
        runs.append(saved(run, workspace.run_path(f"pass-{number + 1}")))
    return workspace, runs, world


@lru_cache(maxsize=2)
def _painter(world: ChangingStreet, number: int) -> Painter:
    """Of the street as it is in a pass. Textures cost a second."""
    layout, street = world.street.layout, world.street
    gone = {id_ for id_, after in world.vanishes.items() if number >= after}
    gone |= {id_ for id_, before in world.appears.items() if number < before}
    back = {id_: world.offset_m[id_] for id_, before in world.moves.items() if number < before}
    poles = tuple(
        replace(
            pole,
            bottom_m=pole.bottom_m + back.get(pole.id, 0.0),
            peak_m=pole.peak_m + back.get(pole.id, 0.0),
        )
        for pole in layout.poles
        if pole.id not in gone
    )
    signs = tuple(sign for sign in layout.signs if sign.id not in gone)
    return Painter(replace(layout, poles=poles, signs=signs), street.seed)


def _painted(world: ChangingStreet, number: int, index: int) -> bytes:
    """The left image of a frame as the street is in a pass."""
    image = _painter(world, number).paint(world.street.view(index, "left"))
    return cv2.imencode(".jpg", image[:, :, ::-1])[1].tobytes()

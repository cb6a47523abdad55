"""Bears writing processes to be killed: for each "FILE SEED" on its input it forks one.

Prints "born PID", then of each operation "NUMBER REQUEST" when it is acknowledged, and "gone" when
the process has ended. Forked, as two hundred interpreters would take minutes to start.
"""

import os
import sys
from pathlib import Path

import numpy as np
from random_edits import pole

from semviz_annotation.labels.edits import AddMany, MoveObservation
from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.store import LabelStore


def write(path: Path, seed: int) -> None:
    """Draw, move, undo and redo without end; the write-ahead log is taken over often."""
    rng = np.random.default_rng(seed)
    with LabelStore.open(path) as store:
        store._file.connection.execute("PRAGMA wal_autocheckpoint = 16")
        while True:
            request, edit = new_id(), pole(int(rng.integers(50)))
            match rng.integers(4):
                case 0:
                    done = store.apply(AddMany((edit, pole(3))), "ann", request)
                case 1 if store.undoable("ann"):
                    done = store.undo("ann", request)
                case _:
                    store.apply(edit, "bea")
                    place = (float(rng.uniform(0.0, 300.0)), 2.0)
                    done = store.apply(MoveObservation(edit.observation_id, place), "bea", request)
            say(f"{done.number} {request}")


def say(line: str) -> None:
    os.write(1, f"{line}\n".encode())


if __name__ == "__main__":
    for line in sys.stdin:
        path, seed = line.rsplit(maxsplit=1)
        pid = os.fork()
        if not pid:
            write(Path(path), int(seed))
        say(f"born {pid}")
        os.waitpid(pid, 0)
        say("gone")

"""A process that labels: python worker.py FILE AUTHOR COUNT. Prints each acknowledged operation."""

import sys
from pathlib import Path

from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.store import LabelStore

if __name__ == "__main__":
    path, author, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    print("ready", flush=True)
    with LabelStore.open(path) as store:
        for frame in range(count):
            edit = AddObservation(
                new_id(), new_id(), frame, "left", (1.0, 2.0), (3.0, 4.0), class_id=0
            )
            request_id = new_id()
            number = store.apply(edit, author, request_id).number
            print(number, request_id, flush=True)

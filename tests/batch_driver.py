"""A process that runs a batch of slow commands, for tests that kill it: ADDRESS COLLECTION."""

import sys

from slow_drives import slow_command

from semviz.batch.batch import DriveBatch, Plan
from semviz.batch.cluster import Cluster
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive


def main(address: str, where: str) -> None:
    """Do all drives that are not done; print those that are."""
    batch = DriveBatch.begin(Collection.open(where), "june", Plan("localize"))
    done = {outcome.drive for outcome in batch.done_before()}
    drives = [Drive(f"d{number:02}", "/nowhere") for number in range(60)]
    left = [drive for drive in drives if drive.name not in done]
    for outcome in Cluster(address).run(Work(where, "june", slow_command), left, print):
        said = outcome.drive, outcome.failure or "done"
        print(*said, file=sys.__stdout__, flush=True)  # sys.stdout is that of Ray meanwhile


if __name__ == "__main__":
    main(*sys.argv[1:])

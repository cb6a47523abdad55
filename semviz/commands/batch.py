"""The commands batch detect, localize, map and evaluate."""

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from semviz.commands import parsing
from semviz.commands.detect import DetectCommand
from semviz.commands.localize import LocalizeCommand
from semviz.commands.maps import MapBuildCommand
from semviz_core.common.errors import SemvizError, require_extra

if TYPE_CHECKING:
    from semviz.batch.batch import BatchCommand, DriveBatch, DriveOutcome
    from semviz.batch.cluster import Cluster
    from semviz.collection.collection import Collection, Drive

_COMMANDS: "dict[BatchCommand, type[DetectCommand | LocalizeCommand | MapBuildCommand]]" = {
    "detect": DetectCommand,
    "localize": LocalizeCommand,
    "map": MapBuildCommand,
}


def run_command(command: "BatchCommand", arguments: list[str]) -> int:
    """Run a command for one workspace, and return its exit status. Raise SemvizError."""
    return _parsed(command, arguments).run()


def _parsed(
    command: "BatchCommand", arguments: list[str]
) -> DetectCommand | LocalizeCommand | MapBuildCommand:
    name = "map build" if command == "map" else command
    return tyro.cli(
        _COMMANDS[command], args=arguments, prog=f"semviz {name}", config=(OmitArgPrefixes,)
    )


@dataclass(frozen=True)
class ClusterOptions:
    """Where the work is done."""

    ray: parsing.OptionalText = None
    """Address of a Ray cluster, HOST:PORT; default: all cores of this machine."""
    cpus: float = 1.0
    """Cores for each drive."""
    gpus: float = 0.0
    """GPUs for each drive, for example 0.25; default: none."""

    def cluster(self) -> "Cluster":
        from semviz.batch.cluster import Cluster

        require_extra("semviz batch", "ray", "ray")
        if not self.cpus > 0.0 or self.gpus < 0.0:
            raise SemvizError("--cpus must be more than 0, --gpus 0 or more")
        return Cluster(self.ray, self.cpus, self.gpus)


@dataclass(frozen=True)
class _DriveCommand:
    """A command for each drive of a collection."""

    collection: Annotated[Positional[str], arg(metavar="COLLECTION")]
    """Folder or URL of the collection."""
    options: Annotated[Positional[tuple[str, ...]], arg(metavar="OPTION")] = ()
    """After '--': options of the command for each drive. {drive} stands for its name, {workspace}
    for its folder."""
    name: parsing.OptionalText = None
    """Name of the batch; default: that of the command. The same name goes on."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    json: bool = False
    """Print one JSON object instead of text."""

    def _run_batch(self, command: "BatchCommand") -> "tuple[DriveBatch, list[DriveOutcome]]":
        """Run the command for all drives that are not done. Return what came of each."""
        from semviz.batch.batch import DriveBatch, Plan
        from semviz.batch.work import Work
        from semviz.collection.collection import Collection

        cluster = self.cluster.cluster()
        collection = Collection.open(self.collection)
        drives = collection.drives()
        self._check_options(command, drives)
        name = self.name or command
        version = self._map_version(collection, DriveBatch.find(collection, name))
        batch = DriveBatch.begin(collection, name, Plan(command, self.options, version))
        work = Work(_absolute(self.collection), name, run_command)
        done = _still_valid(batch, drives)
        left = [drive for drive in drives if drive.name not in done]
        outcomes = _outcomes(cluster, work, left, command)
        given = [done[drive.name] for drive in drives if drive.name in done]
        return batch, [*given, *outcomes]

    def _map_version(self, collection: "Collection", begun: "DriveBatch | None") -> int | None:
        """Return the version of the collection's map that the command uses, if it uses one."""
        return None

    def _check_options(self, command: "BatchCommand", drives: "tuple[Drive, ...]") -> None:
        """Parse the options for the first drive: what is wrong with them is wrong for all."""
        if not drives:
            raise SemvizError(
                f"{self.collection}: no drives yet; add workspaces with 'semviz collection add'"
            )
        _parsed(command, [drives[0].workspace, *self.options])
        for option in ("--json", "--out"):
            if option in self.options:
                raise SemvizError(f"{option} is the batch's own; leave it out")


def _still_valid(batch: "DriveBatch", drives: "Sequence[Drive]") -> "dict[str, DriveOutcome]":
    """Return what came of the drives that are done, by name. Those whose inputs have changed since
    are told, and forgotten."""
    from semviz.batch.inputs import changes_since

    done = {outcome.drive: outcome for outcome in batch.done_before()}
    known = [(drive, done[drive.name]) for drive in drives if drive.name in done]
    again, unread = changes_since(batch.plan, known)
    for drive, changed in again.items():
        print(f"{drive}: {', '.join(changed)} changed since; done again", file=sys.stderr)
        batch.forget(drive)
    if unread:
        print(
            f"workspaces of {unread} drives that are done cannot be read here; whether they have "
            "changed is not known",
            file=sys.stderr,
        )
    return {name: one for name, one in done.items() if name not in again}


def _absolute(where: str) -> str:
    """Return the place of a collection for processes that work in other folders."""
    return where if "://" in where else str(Path(where).absolute())


def _outcomes(
    cluster: "Cluster",
    work: "Callable[[Drive], DriveOutcome]",
    drives: "Sequence[Drive]",
    what: str,
) -> "list[DriveOutcome]":
    """Return what comes of each drive, in the order in which they end. Failures are told at
    once."""
    from semviz.presentation.terminal import track

    outcomes: list[DriveOutcome] = []
    if not drives:
        return outcomes
    outcomes_of = cluster.run(work, drives, lambda line: print(line, file=sys.stderr))
    for outcome in track(outcomes_of, what, len(drives)):
        if outcome.failure:
            print(f"{outcome.drive} failed: {outcome.failure}", file=sys.stderr)
        outcomes.append(outcome)
    return outcomes


@dataclass(frozen=True)
class BatchDetectCommand(_DriveCommand):
    """Run 'semviz detect' for all drives of a collection, on the machines of a Ray cluster.

    Run the same command again to go on.

    Example: 'semviz batch detect city -- --sides left'."""

    def run(self) -> int:
        started_s = perf_counter()
        batch, outcomes = self._run_batch("detect")
        totals = {
            name: sum(outcome.printed[name] for outcome in outcomes if not outcome.failure)
            for name in ("images", "proposals")
        }
        said = ", ".join(f"{total} {name}" for name, total in totals.items())
        return _report(self, batch, outcomes, totals, said, perf_counter() - started_s)


@dataclass(frozen=True)
class BatchLocalizeCommand(_DriveCommand):
    """Run 'semviz localize' for all drives of a collection, on the machines of a Ray cluster, in
    the collection's map if it has one. Run the same command again to go on.

    Example: 'semviz batch localize city -- --observations detected --track'."""

    map_version: parsing.OptionalInt = None
    """Version of the collection's map; default: the newest one when the batch begins."""

    def run(self) -> int:
        started_s = perf_counter()
        batch, outcomes = self._run_batch("localize")
        status: Counter[str] = Counter()
        for outcome in outcomes:
            status.update(outcome.printed.get("status", {}))
        said = ", ".join(f"{number} {name}" for name, number in sorted(status.items()))
        seconds = perf_counter() - started_s
        exit_status = _report(self, batch, outcomes, {"status": dict(status)}, said, seconds)
        if not self.json:
            print(f"next: semviz batch evaluate {self.collection} --name {batch.name}")
        return exit_status

    def _map_version(self, collection: "Collection", begun: "DriveBatch | None") -> int | None:
        from semviz_core.map_tiles.manifest import versions

        if {"--map", "--collection"} & set(self.options):
            return None
        if self.map_version is None and begun is not None:
            return begun.plan.map_version
        return self.map_version or max(versions(collection.store), default=None)


@dataclass(frozen=True)
class BatchMapCommand(_DriveCommand):
    """Run 'semviz map build' for all drives of a collection, on the machines of a Ray cluster; then
    merge their maps, and publish the result as the collection's map.

    Run the same command again to go on.

    Example: 'semviz batch map city -- --from detections'."""

    pose_sigma_m: float = 0.5
    """Error of each drive's poses, in each direction."""
    pose_sigma_deg: float = 0.5
    """Error of each drive's heading."""
    partial: bool = False
    """Merge and publish even if some drives failed."""

    def run(self) -> int:
        from semviz.batch.merging import publish_merged
        from semviz.presentation.terminal import Steps
        from semviz_annotation.mapping.drives.corrections import PoseErrors

        started_s = perf_counter()
        errors = PoseErrors(self.pose_sigma_m, radians(self.pose_sigma_deg))
        batch, outcomes = self._run_batch("map")
        said, totals = "not merged: all must be done, or add --partial", dict[str, Any]()
        if self.partial or not any(outcome.failure for outcome in outcomes):
            with Steps() as steps:
                published = publish_merged(batch, errors, steps.show)
            totals, said = published.as_dict(), str(published)
        return _report(self, batch, outcomes, totals, said, perf_counter() - started_s)


@dataclass(frozen=True)
class BatchEvaluateCommand:
    """Evaluate the runs of 'semviz batch localize' on the machines of a Ray cluster: one table of
    all drives.

    Example: 'semviz batch evaluate city --frames frames.parquet'."""

    collection: Annotated[Positional[str], arg(metavar="COLLECTION")]
    """Folder or URL of the collection."""
    name: str = "localize"
    """Name of the batch."""
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    frames: parsing.OptionalPath = None
    """Also write a row for each frame of all drives to this Parquet file."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.batch.batch import DriveBatch
        from semviz.batch.evaluation import BatchEvaluation, Tabulate
        from semviz.batch.inputs import changes_since
        from semviz.collection.collection import Collection, Drive
        from semviz.workspace.outputs import PARQUET, check_outputs

        if self.frames is not None:
            check_outputs(self.frames, PARQUET, force=self.force)
        cluster = self.cluster.cluster()
        collection = Collection.open(self.collection)
        batch = DriveBatch.open(collection, self.name)
        runs = {one.drive: one for one in batch.done_before() if "run" in one.printed}
        if not runs:
            raise SemvizError(f"batch {self.name} has no runs; only those of localize have")
        known = [(one, runs[one.name]) for one in collection.drives() if one.name in runs]
        for name, changed in changes_since(batch.plan, known)[0].items():
            print(
                f"{name}: {', '.join(changed)} changed since it was localized; 'semviz batch "
                "localize' does it again",
                file=sys.stderr,
            )
        done = set(batch.drives_with("frames"))
        drives = [Drive(name, "") for name in runs if name not in done]
        work = Tabulate(_absolute(self.collection), self.name)
        outcomes = _outcomes(cluster, work, drives, "evaluating")
        evaluation = BatchEvaluation.of(batch)
        if self.frames is not None:
            evaluation.save(self.frames)
        print(json.dumps(evaluation.as_dict()) if self.json else evaluation.as_text())
        return 1 if any(outcome.failure for outcome in outcomes) else 0


def _report(
    command: _DriveCommand,
    batch: "DriveBatch",
    outcomes: "list[DriveOutcome]",
    totals: dict[str, Any],
    said: str,
    seconds: float,
) -> int:
    """Print what came of all drives. Return the exit status."""
    failures = {outcome.drive: outcome.failure for outcome in outcomes if outcome.failure}
    before = sum(outcome.was_done for outcome in outcomes)
    core_hours = sum(outcome.seconds for outcome in outcomes) * command.cluster.cpus / 3600.0
    done = len(outcomes) - len(failures)
    if command.json:
        times = {"seconds": seconds, "core_hours": core_hours}
        counts = {"drives": len(outcomes), "done": done, "done_before": before}
        print(json.dumps({"batch": batch.name, **counts, "failed": failures, **totals, **times}))
    else:
        print(
            f"{batch.name}: {done} of {len(outcomes)} drives done ({before} of them before), "
            f"{len(failures)} failed; {said}"
        )
        print(f"{seconds:.0f} s, {core_hours:.2f} core-hours in all")
    return 1 if failures else 0

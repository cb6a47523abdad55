"""The ``semviz`` command: parse arguments, run a subcommand, print an error as one line.

Bad input exits with status 2.
"""

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from semviz.commands import batch, classes, collection, labels, map_changes, map_files, maps, runs
from semviz.commands.backdrop import MapBackdropCommand
from semviz.commands.detect import DetectCommand, DetectEvaluateCommand, DetectTrainCommand
from semviz.commands.detector_rates import DetectRatesCommand
from semviz.commands.localize import LocalizeCommand
from semviz.commands.map_merge import MapMergeCommand
from semviz.commands.new import NewCommand, RelinkCommand
from semviz.commands.poses import PosesCheckCommand, PosesChooseCommand, PosesRefineCommand
from semviz.commands.record import RecordCommand
from semviz.commands.research import (
    BenchmarkCommand,
    DetectChooseCommand,
    TrainCommand,
    WeightsCommand,
)
from semviz.commands.tools import AnnotateCommand, OpenRunCommand, ServeCommand
from semviz_core.common.errors import SemvizError, file_error_text

MapCommands = Annotated[
    Annotated[maps.MapBuildCommand, subcommand("build")]
    | Annotated[maps.MapCheckCommand, subcommand("check")]
    | Annotated[maps.MapDiffCommand, subcommand("diff")]
    | Annotated[map_changes.MapChangesCommand, subcommand("changes")]
    | Annotated[MapMergeCommand, subcommand("merge")]
    | Annotated[maps.MapLocalizabilityCommand, subcommand("localizability")]
    | Annotated[map_files.MapExportCommand, subcommand("export")]
    | Annotated[map_files.MapImportCommand, subcommand("import")]
    | Annotated[MapBackdropCommand, subcommand("backdrop")],
    subcommand(
        "map", description="Build maps from labels; merge, check, compare, import and export them."
    ),
]
PoseCommands = Annotated[
    Annotated[PosesCheckCommand, subcommand("check")]
    | Annotated[PosesRefineCommand, subcommand("refine")]
    | Annotated[PosesChooseCommand, subcommand("choose")],
    subcommand(
        "poses",
        description="Check poses against the images of a workspace; refine them, or choose what to "
        "do with wrong ones.",
    ),
]
LabelCommands = Annotated[
    Annotated[labels.LabelsExportCommand, subcommand("export")]
    | Annotated[labels.LabelsImportCommand, subcommand("import")]
    | Annotated[labels.LabelsProposeCommand, subcommand("propose")]
    | Annotated[labels.LabelsCheckCommand, subcommand("check")]
    | Annotated[labels.LabelsBackupCommand, subcommand("backup")]
    | Annotated[labels.LabelsRestoreCommand, subcommand("restore")],
    subcommand("labels", description="Import, export, check and back up labels; import proposals."),
]
ClassCommands = Annotated[
    Annotated[classes.ClassesListCommand, subcommand("list")]
    | Annotated[classes.ClassesAddCommand, subcommand("add")]
    | Annotated[classes.ClassesChangeCommand, subcommand("change")]
    | Annotated[classes.ClassesRemoveCommand, subcommand("remove")]
    | Annotated[classes.ClassesAttributeCommand, subcommand("attribute")],
    subcommand("classes", description="Classes and attributes of a workspace's own."),
]
DetectCommands = Annotated[
    Annotated[DetectCommand, subcommand("run")]
    | Annotated[DetectTrainCommand, subcommand("train")]
    | Annotated[DetectEvaluateCommand, subcommand("evaluate")]
    | Annotated[DetectChooseCommand, subcommand("choose")]
    | Annotated[DetectRatesCommand, subcommand("rates")],
    subcommand(
        "detect",
        description="Detect poles and signs in the images of a workspace: detect WORKSPACE. "
        "Train, evaluate and calibrate the detector.",
    ),
]
BatchCommands = Annotated[
    Annotated[batch.BatchDetectCommand, subcommand("detect")]
    | Annotated[batch.BatchLocalizeCommand, subcommand("localize")]
    | Annotated[batch.BatchMapCommand, subcommand("map")]
    | Annotated[batch.BatchEvaluateCommand, subcommand("evaluate")],
    subcommand("batch", description="Run a command for all drives of a collection, with Ray."),
]
CollectionCommands = Annotated[
    Annotated[collection.CollectionCreateCommand, subcommand("create")]
    | Annotated[collection.CollectionAddCommand, subcommand("add")]
    | Annotated[collection.CollectionShowCommand, subcommand("show")]
    | Annotated[collection.CollectionPublishCommand, subcommand("publish")]
    | Annotated[collection.CollectionExportCommand, subcommand("export")],
    subcommand(
        "collection", description="Many drives and one map of them in tiles, in a folder or S3."
    ),
]
Command = (
    Annotated[ServeCommand, subcommand("serve")]
    | Annotated[NewCommand, subcommand("new")]
    | Annotated[RelinkCommand, subcommand("relink")]
    | Annotated[AnnotateCommand, subcommand("annotate")]
    | DetectCommands
    | PoseCommands
    | MapCommands
    | CollectionCommands
    | BatchCommands
    | Annotated[LocalizeCommand, subcommand("localize")]
    | Annotated[RecordCommand, subcommand("record")]
    | Annotated[runs.EvaluateCommand, subcommand("evaluate")]
    | Annotated[runs.CompareCommand, subcommand("compare")]
    | Annotated[runs.ReportCommand, subcommand("report")]
    | Annotated[OpenRunCommand, subcommand("open")]
    | Annotated[runs.RepairCommand, subcommand("repair")]
    | Annotated[runs.TrajectoryCommand, subcommand("trajectory")]
    | LabelCommands
    | ClassCommands
    | Annotated[BenchmarkCommand, subcommand("benchmark")]
    | Annotated[TrainCommand, subcommand("train")]
    | Annotated[WeightsCommand, subcommand("weights")]
)


_SUBCOMMANDS = ("run", "train", "evaluate", "choose", "rates")
_AFTER_DETECT: tuple[list[str], ...] = (*([name] for name in _SUBCOMMANDS), ["-h"], ["--help"], [])
"""What can follow ``semviz detect`` besides a workspace."""
RUST_LOG = "warn,re_log_encoding=off,re_sdk=off"
"""What rerun writes to the terminal: a run that cannot be written is our own line."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command, and exit with its status.

    0: done; 1: a check failed; 2: bad input; 130: interrupted; 141: the output pipe was closed.
    """
    os.environ.setdefault("RUST_LOG", RUST_LOG)
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(f"semviz {version('semviz')}")
        sys.exit(0)
    command = tyro.cli(
        Command,
        args=_with_detect_run(given),
        prog="semviz",
        description="Debug localization in sparse semantic maps of poles and traffic signs.",
        config=(OmitArgPrefixes, OmitSubcommandPrefixes),
    )
    try:
        status = command.run()
        sys.stdout.flush()
    except SemvizError as error:
        status = _print_error(str(error))
    except BrokenPipeError:  # the reader (head, less) closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 141
    except OSError as error:  # for example no permission, a full disk, a name too long
        status = _print_error(file_error_text(error))
    except KeyboardInterrupt:
        print("semviz: interrupted", file=sys.stderr)
        status = 130
    sys.exit(status)


def _with_detect_run(arguments: list[str]) -> list[str]:
    """Make ``semviz detect WORKSPACE`` mean ``semviz detect run WORKSPACE``.

    tyro has no default subcommand. For a workspace called ``train``, write ``./train``.
    """
    if arguments[:1] != ["detect"] or arguments[1:2] in _AFTER_DETECT:
        return arguments
    return ["detect", "run", *arguments[1:]]


def _print_error(message: str) -> int:
    """Print an error as one line. Return exit status 2."""
    print("semviz:", " ".join(message.splitlines()), file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()

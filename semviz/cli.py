"""The ``semviz`` command: parse, call, and turn people's mistakes into one line."""

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from semviz.commands.annotate import Annotate
from semviz.commands.benchmark import Benchmark
from semviz.commands.compare import Compare
from semviz.commands.detect import Detect
from semviz.commands.detect_evaluate import DetectEvaluate
from semviz.commands.detect_train import DetectTrain
from semviz.commands.evaluate import Evaluate
from semviz.commands.label_file import LabelsBackup, LabelsCheck, LabelsRestore
from semviz.commands.labels import LabelsExport, LabelsImport, LabelsPropose
from semviz.commands.localize import Localize
from semviz.commands.map_build import MapBuild
from semviz.commands.map_check import MapCheck
from semviz.commands.map_diff import MapDiff
from semviz.commands.map_export import MapExport
from semviz.commands.map_import import MapImport
from semviz.commands.map_localizability import MapLocalizability
from semviz.commands.new import New
from semviz.commands.open_run import OpenRun
from semviz.commands.repair import Repair
from semviz.commands.report import Report
from semviz.commands.serve import Serve
from semviz.commands.train import Train
from semviz.commands.trajectory import Trajectory
from semviz.commands.weights import Weights
from semviz_core.errors import SemvizError

MapCommands = Annotated[
    Annotated[MapBuild, subcommand("build")]
    | Annotated[MapCheck, subcommand("check")]
    | Annotated[MapDiff, subcommand("diff")]
    | Annotated[MapLocalizability, subcommand("localizability")]
    | Annotated[MapExport, subcommand("export")]
    | Annotated[MapImport, subcommand("import")],
    subcommand("map", description="Maps: built from labels, checked, compared, in and out."),
]
LabelCommands = Annotated[
    Annotated[LabelsExport, subcommand("export")]
    | Annotated[LabelsImport, subcommand("import")]
    | Annotated[LabelsPropose, subcommand("propose")]
    | Annotated[LabelsCheck, subcommand("check")]
    | Annotated[LabelsBackup, subcommand("backup")]
    | Annotated[LabelsRestore, subcommand("restore")],
    subcommand("labels", description="Labels in and out, checked, backed up; proposals in."),
]
DetectCommands = Annotated[
    Annotated[Detect, subcommand("run")]
    | Annotated[DetectTrain, subcommand("train")]
    | Annotated[DetectEvaluate, subcommand("evaluate")],
    subcommand(
        "detect",
        description="Poles and signs found in the images of a workspace: detect WORKSPACE. And "
        "what finds them: trained, evaluated.",
    ),
]
Command = (
    Annotated[Serve, subcommand("serve")]
    | Annotated[New, subcommand("new")]
    | Annotated[Annotate, subcommand("annotate")]
    | DetectCommands
    | MapCommands
    | Annotated[Localize, subcommand("localize")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Report, subcommand("report")]
    | Annotated[OpenRun, subcommand("open")]
    | Annotated[Repair, subcommand("repair")]
    | Annotated[Trajectory, subcommand("trajectory")]
    | LabelCommands
    | Annotated[Benchmark, subcommand("benchmark")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Weights, subcommand("weights")]
)


_BELOW_DETECT: tuple[list[str], ...] = (["run"], ["train"], ["evaluate"], ["-h"], ["--help"], [])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command. Exit status: 0 done, 1 a check failed, 2 bad input, 130 interrupted,
    141 nobody reads the output any more."""
    command = tyro.cli(
        Command,
        args=_spelled_out(list(sys.argv[1:] if arguments is None else arguments)),
        prog="semviz",
        description="See and mend localization in sparse semantic maps of poles and traffic signs.",
        config=(OmitArgPrefixes, OmitSubcommandPrefixes),
    )
    try:
        status = command.run()
        sys.stdout.flush()
    except SemvizError as error:
        status = _refuse(str(error))
    except BrokenPipeError:  # whoever read our output (head, less) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 141
    except OSError as error:  # what the system refuses: permissions, a full disk, a name too long
        where = "" if error.filename is None else f"{error.filename}: "
        status = _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        print("semviz: interrupted", file=sys.stderr)
        status = 130
    sys.exit(status)


def _spelled_out(arguments: list[str]) -> list[str]:
    """``semviz detect WORKSPACE`` is ``semviz detect run WORKSPACE``: commands with others below
    them have no default in tyro. A workspace that is called like one of those is ``./train``."""
    if arguments[:1] != ["detect"] or arguments[1:2] in _BELOW_DETECT:
        return arguments
    return ["detect", "run", *arguments[1:]]


def _refuse(why: str) -> int:
    print("semviz:", " ".join(why.splitlines()), file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()

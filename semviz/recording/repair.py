"""A run written anew: what a broken off file still holds, as a whole file."""

from pathlib import Path

from semviz.recording.pictures import seen_from
from semviz.recording.reader import load_run
from semviz.recording.run import Run
from semviz.recording.writer import RunWriter
from semviz_core.files import replacing


def repair(path: Path, out: Path) -> Run:
    """Write all whole frames of the run in ``path`` to ``out``, which may be the same file.

    A run that was interrupted stays marked as such. Raises SemvizError where ``path`` cannot be
    read, or ``out`` not be written.
    """
    run = load_run(path)
    with (
        replacing(out) as temporary,
        RunWriter(temporary, run.info, run.semantic_map, completes=run.complete) as writer,
    ):
        for one in run.frames:
            writer.write(seen_from(out.parent, one, path.parent))
    return run

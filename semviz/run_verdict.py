"""What a run says of its map and camera, and of each element: its frames, handed to explaining."""

from semviz.recording.run import Run
from semviz.verdicts import detector_of, truth_of
from semviz_core.explaining.case import Watch, unwatched
from semviz_core.explaining.per_element import ElementRecord, element_records
from semviz_core.explaining.run_verdict import RunVerdict, explain_run
from semviz_core.explaining.told import Truth
from semviz_core.localization import Localization


def run_verdict(run: Run, watch: Watch = unwatched) -> RunVerdict:
    """Faults of camera and map that come back in frame after frame."""
    return explain_run(_told(run), run.semantic_map, detector_of(run), watch)


def run_elements(run: Run, watch: Watch = unwatched) -> tuple[ElementRecord, ...]:
    """Every map element that some frame sees or should see; outliers in most frames first."""
    return element_records(_told(run), run.semantic_map, detector_of(run), watch)


def _told(run: Run) -> list[tuple[Localization, Truth | None]]:
    return [(one.localization, truth_of(run, one)) for one in run.frames]

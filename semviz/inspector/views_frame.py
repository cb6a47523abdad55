"""Messages about one frame: the selection and its labels, the solver, the other images."""

from typing import Literal

from semviz.inspector.views import Ends
from semviz.web.protocol import Event, Part

Labelled = tuple[str, str]
"""A label and its value."""


class MatrixCell(Part):
    """A cell of the probability matrix; a null row or column is the dustbin."""

    name: str
    observed: int | None
    element: int | None
    probability: float
    rank: int
    is_true: bool


class ResidualView(Part):
    """The residual of ``pair`` at the estimate or the true pose, or the reason for its absence."""

    pair: str
    at: Literal["estimate", "truth"]
    reason: str = ""
    px: float | None = None
    across_px: float | None = None
    along_px: float | None = None
    """Null for a pole whose ends are unknown."""
    chi2: float | None = None
    limit: float | None = None
    fits: bool = False


class EndView(Part):
    """An end of an element: distance from the camera, and 1 sigma across, along, up (m)."""

    end: str
    known: bool
    distance_m: float
    sigma_m: tuple[float, float, float]


class MapDecision(Part):
    """A decision of map building about the label elements behind a map element."""

    kind: str
    by: str
    reason: str
    names: tuple[str, ...]


class ElementCard(Part):
    """A map element, from the camera of one frame."""

    name: str
    class_id: int
    place: tuple[EndView, ...]
    meaning: str
    """Basis of the sigmas."""
    existence: str
    """The probability that it exists, of an element from detections alone; else empty."""
    in_run: tuple[Labelled, ...]
    decisions: tuple[MapDecision, ...]


class SelectionCard(Part):
    """The selected detection, element or pair."""

    observed: int | None
    element: int | None
    name: str
    class_id: int
    summary: tuple[str, ...]
    residuals: tuple[ResidualView, ...]
    of_row: tuple[MatrixCell, ...]
    """Likely elements of the detection."""
    of_column: tuple[MatrixCell, ...]
    """Likely detections of the element."""
    mapped: ElementCard | None


class WriterView(Part):
    """The label operation that last changed a label element."""

    author: str
    origin: str
    time: str
    number: int
    kind: str


class OriginView(Part):
    """A label element behind a map element."""

    name: str
    class_id: int
    left: int
    right: int
    """Number of observations used, by image."""
    frames: tuple[tuple[int, str], ...]
    """Their frames with ``L``, ``R`` or ``LR``."""
    others: int
    """Number of observations not used."""
    writer: WriterView | None
    is_newer: bool
    """Edited after the map was built."""


class SelectionEvent(Event):
    """The selection; null where nothing is selected."""

    type: Literal["selection"] = "selection"
    card: SelectionCard | None


class OriginsEvent(Event):
    """The labels behind an element, or the reason why there are none."""

    type: Literal["origins"] = "origins"
    element: int
    reason: str
    entries: tuple[OriginView, ...]


class PoseDifference(Part):
    """The difference between two poses."""

    m: float
    deg: float


class SearchPoseView(Part):
    """A candidate pose of the search; ``score`` and ``behind`` (the best) in nats."""

    letter: str
    score: float | None
    behind: float | None
    share: float
    pairs: int | None
    from_answer: PoseDifference | None
    from_truth: PoseDifference | None


class SearchView(Part):
    """Numbers of poses evaluated and consistent with the prior, and the best poses."""

    tried: int
    passed: int | None
    poses: tuple[SearchPoseView, ...]


class SolvedPair(Part):
    """A pair of the estimate."""

    observed: int
    element: int
    name: str
    class_id: int
    inlier: bool
    is_true: bool | None
    residual_px: float | None
    chi2: float | None
    support_nats: float | None
    open_m: float | None


class TraceView(Part):
    """Cost and step of each iteration, and the distance from the best pose of the search."""

    cost: tuple[float | None, ...]
    steps: tuple[PoseDifference, ...]
    moved: PoseDifference | None


class SolverEvent(Event):
    """How a frame was solved; stages that the method lacks are null."""

    type: Literal["solver"] = "solver"
    position: int
    stages: tuple[tuple[str, float], ...]
    search: SearchView | None
    pairs: tuple[SolvedPair, ...] | None
    trace: TraceView | None
    notes: tuple[str, ...]
    shown: int | None = None
    """Row of the pose shown in 3D."""


class RightMapped(Part):
    """An element of the submap in the right image."""

    estimate: Ends | None
    truth: Ends | None


class RightImageEvent(Event):
    """The submap in the right image of a frame."""

    type: Literal["right_image"] = "right_image"
    position: int
    mapped: tuple[RightMapped, ...]


class PlacedElement(Part):
    """An element in an image."""

    class_id: int
    place: Ends


class NeighbourView(Part):
    """A neighbouring frame, with the selected element as detected and as mapped."""

    position: int
    seen: PlacedElement | None
    mapped: PlacedElement | None


class NeighboursEvent(Event):
    """The neighbouring frames."""

    type: Literal["neighbours"] = "neighbours"
    frames: tuple[NeighbourView, ...]

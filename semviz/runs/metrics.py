"""Measure a run: pose errors, named metrics, and gates on the metrics.

A frame is overconfident if its status is ok and it is more than 1 m off. A gate is a condition like
``median_rte_m > 1.05*base``, parsed without executing code. It rejects an interrupted run: that
run's metrics are not those of the whole sequence.
"""

import ast
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semviz.runs.run import FrameRecord, Run
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import Summary, summarize

OVERCONFIDENT_M = 1.0


@dataclass(frozen=True)
class Errors:
    """Pose errors: distance of the camera centres, angle between the rotations."""

    distance_m: float
    angle_deg: float


def errors_of(record: FrameRecord) -> Errors | None:
    """Return the errors of a frame; None without a true pose or without an estimate."""
    truth, estimate = record.frame.T_map_camera, record.localization.T_camera_map
    if truth is None or estimate is None:
        return None
    return difference(estimate.inverse(), truth)


def difference(a: Pose, b: Pose) -> Errors:
    """Return the difference of two poses T_map_camera."""
    angle_deg = float(np.rad2deg(angle_between(a.rotation, b.rotation)))
    return Errors(float(np.linalg.norm(a.translation - b.translation)), angle_deg)


def is_overconfident(localization: Localization, errors: Errors | None) -> bool:
    """Whether the status is ok, but the pose is more than 1 m off."""
    error_m = 0.0 if errors is None else errors.distance_m
    return localization.status == "ok" and error_m > OVERCONFIDENT_M


def summarize_run(run: Run) -> Summary:
    """Summarize errors, status and runtime over all frames of a run, read one after the other."""
    truths = (frame.frame.T_map_camera for frame in run.frames)
    return summarize(
        (frame.localization for frame in run.frames),
        (None if truth is None else truth.inverse() for truth in truths),
    )


def settings_of(run: Run) -> dict[str, str]:
    """Return the settings of a run as texts, by name."""
    info = run.info
    return {
        "method": info.method,
        "map": f"{info.map_name} ({run.semantic_map.digest[:12]})",
        "observations": info.observations,
        "seed": str(info.seed),
        "semviz": info.version,
        **{name: str(value) for name, value in info.options.items()},
    }


Metrics = dict[str, float | None]
"""Metrics by name; None if unknown, for example errors without true poses."""
DIAGNOSED = "diagnosed_"
"""Start of the metrics that count the frames of a diagnosis."""

Trend = Literal["better", "worse", "same"]
MORE_IS_BETTER = frozenset(
    {"share_below_1m", "share_below_1deg", "coverage", f"{DIAGNOSED}healthy"}
)
NEITHER = frozenset({"frames", "share_ambiguous"})
"""Metrics of which neither more nor less is better. Ambiguous frames are better than failed ones,
and worse than located ones."""


def trend(name: str, base: float | None, other: float | None) -> Trend:
    """Return whether the other run is better in a metric; ``same`` if that is unknown."""
    if base is None or other is None or base == other or name in NEITHER:
        return "same"
    return "better" if (other > base) == (name in MORE_IS_BETTER) else "worse"


BASE = "base"
"""In a condition: the value of its metric in the base run."""
MAX_LENGTH = 200
"""Maximum length of a condition in characters, which also keeps nesting shallow."""
_ARITHMETIC: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_SIGNS: dict[type, Callable[[float], float]] = {ast.USub: operator.neg, ast.UAdd: operator.pos}
_COMPARISONS: dict[type, Callable[[float, float], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}


@dataclass(frozen=True)
class Condition:
    """A comparison of arithmetic expressions of metrics, numbers and ``base``."""

    text: str
    tree: ast.Compare
    metrics: tuple[str, ...]
    """Names of its metrics, in order."""
    uses_base: bool

    def holds(self, base: Metrics, other: Metrics) -> bool:
        """Whether the condition holds for the metrics of two runs.

        Raise SemvizError if it names an unknown metric, or one without a value.
        """
        values = self.values(base, other)
        sides = [self._number(side, values) for side in (self.tree.left, *self.tree.comparators)]
        compared = zip(self.tree.ops, sides[:-1], sides[1:], strict=True)
        return all(_COMPARISONS[type(sign)](left, right) for sign, left, right in compared)

    def values(self, base: Metrics, other: Metrics) -> dict[str, float]:
        """Return the value of each name in the condition."""
        values = {name: self._known(name, other, "other run") for name in self.metrics}
        if self.uses_base:
            (name,) = self.metrics
            values[BASE] = self._known(name, base, "base run")
        return values

    def as_text(self, base: Metrics, other: Metrics) -> str:
        """Return the condition with the values of its names."""
        return f"{self.text} ({self.values_text(base, other)})"

    def values_text(self, base: Metrics, other: Metrics) -> str:
        """Return the values of its names as text."""
        values = self.values(base, other).items()
        return ", ".join(f"{name} {value:.4g}" for name, value in values)

    def _known(self, name: str, metrics: Metrics, where: str) -> float:
        if name not in metrics:
            raise self._error(f"no '{name}' in the {where}; choose from {', '.join(metrics)}")
        value = metrics[name]
        if value is None:
            raise self._error(f"{name} of the {where} is unknown: no frame has the data for it")
        return value

    def _number(self, node: ast.expr, values: dict[str, float]) -> float:
        try:
            return _evaluate(node, values)
        except ZeroDivisionError as error:
            raise self._error(f"cannot be computed ({error})") from None

    def _error(self, message: str) -> SemvizError:
        return SemvizError(f"--fail-if '{self.text}': {message}")


def check_complete(run: Run, name: str) -> None:
    """Raise SemvizError if a run was interrupted, or frames of it are damaged."""
    if not run.complete or run.lost:
        raise SemvizError(f"{name}: --fail-if needs a complete run. {run.note}")


def parse_condition(text: str) -> Condition:
    """Parse a condition. Raise SemvizError, with an example, if it is not one."""
    text = " ".join(text.split())
    tree = _syntax_tree(text)
    parts = [] if tree is None else list(ast.walk(tree))[1:]
    if not isinstance(tree, ast.Compare) or not all(map(_is_allowed, parts)):
        raise _unreadable(text)
    names = dict.fromkeys(part.id for part in parts if isinstance(part, ast.Name))
    metrics = tuple(name for name in names if name != BASE)
    if BASE in names and len(metrics) != 1:
        raise SemvizError(
            f"--fail-if '{text}': '{BASE}' is the same metric in the base run, so use exactly one "
            f"metric with it, not {len(metrics)}"
        )
    return Condition(text, tree, metrics, BASE in names)


def _syntax_tree(text: str) -> ast.expr | None:
    """Return the parsed expression; None if it is not one."""
    if len(text) > MAX_LENGTH:
        return None
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        return None


def _is_allowed(node: ast.AST) -> bool:
    if isinstance(node, ast.Constant):
        return type(node.value) in (int, float)
    if isinstance(node, ast.BinOp | ast.UnaryOp | ast.Name | ast.expr_context):
        return True
    return type(node) in {*_ARITHMETIC, *_SIGNS, *_COMPARISONS}


def _evaluate(node: ast.expr, values: dict[str, float]) -> float:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=sign, operand=operand):
            return _SIGNS[type(sign)](_evaluate(operand, values))
        case ast.BinOp(left=left, op=sign, right=right):
            return _ARITHMETIC[type(sign)](_evaluate(left, values), _evaluate(right, values))
    raise AssertionError(f"{node} is not allowed")


def _unreadable(text: str) -> SemvizError:
    shown = text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}..."
    return SemvizError(
        f"--fail-if '{shown}': write a comparison of metrics and numbers with + - * / ( ), for "
        "example 'median_rte_m > 1.05*base'"
    )

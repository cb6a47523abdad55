"""Gates: conditions such as ``median_rte_m > 1.05*base``, read without ever running code."""

import ast
import operator
from collections.abc import Callable
from dataclasses import dataclass

from semviz.comparing.metrics import Metrics
from semviz.recording.run import Run
from semviz_core.errors import SemvizError

BASE = "base"
"""In a condition: the one metric that it names, in the base run."""
LONGEST = 200
"""Characters of a condition; nobody reads longer ones, and nesting stays shallow."""
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
    """A comparison of two sums of metrics, numbers and ``base``."""

    text: str
    tree: ast.Compare
    metrics: tuple[str, ...]
    """Those it names, in order."""
    uses_base: bool

    def holds(self, base: Metrics, other: Metrics) -> bool:
        """Whether it does for the metrics of two runs; ``other`` may have more than the base.

        Raises SemvizError where it names what there is not, or what the runs cannot tell.
        """
        values = self.values(base, other)
        sides = [self._number(side, values) for side in (self.tree.left, *self.tree.comparators)]
        compared = zip(self.tree.ops, sides[:-1], sides[1:], strict=True)
        return all(_COMPARISONS[type(sign)](left, right) for sign, left, right in compared)

    def values(self, base: Metrics, other: Metrics) -> dict[str, float]:
        """What each name in it stands for."""
        values = {name: self._known(name, other, "other run") for name in self.metrics}
        if self.uses_base:
            (name,) = self.metrics
            values[BASE] = self._known(name, base, "base run")
        return values

    def as_text(self, base: Metrics, other: Metrics) -> str:
        """The condition, and what its names stand for."""
        return f"{self.text} ({self.values_text(base, other)})"

    def values_text(self, base: Metrics, other: Metrics) -> str:
        """What its names stand for."""
        values = self.values(base, other).items()
        return ", ".join(f"{name} {value:.4g}" for name, value in values)

    def _known(self, name: str, metrics: Metrics, where: str) -> float:
        if name not in metrics:
            raise self._wrong(f"there is no '{name}' in the {where}; there are {_listed(metrics)}")
        value = metrics[name]
        if value is None:
            raise self._wrong(f"the {where} does not tell {name}: no frame has what it takes")
        return value

    def _number(self, node: ast.expr, values: dict[str, float]) -> float:
        try:
            return _evaluate(node, values)
        except ZeroDivisionError as error:
            raise self._wrong(f"cannot be computed ({error})") from None

    def _wrong(self, why: str) -> SemvizError:
        return SemvizError(f"--fail-if '{self.text}': {why}")


def check_whole(run: Run, name: str) -> None:
    """SemvizError for an interrupted run: its numbers are not those of the drive."""
    if not run.complete:
        raise SemvizError(f"{name}: --fail-if needs a whole run. {run.note}")


def parse_condition(text: str) -> Condition:
    """Read a condition. Raises SemvizError where it is none, with what conditions look like."""
    text = " ".join(text.split())
    tree = _syntax_tree(text)
    parts = [] if tree is None else list(ast.walk(tree))[1:]
    if not isinstance(tree, ast.Compare) or not all(map(_is_allowed, parts)):
        raise _unreadable(text)
    names = dict.fromkeys(one.id for one in parts if isinstance(one, ast.Name))
    metrics = tuple(name for name in names if name != BASE)
    if BASE in names and len(metrics) != 1:
        raise SemvizError(
            f"--fail-if '{text}': '{BASE}' means the same metric in the base run, so name one "
            f"metric beside it, not {len(metrics)}"
        )
    return Condition(text, tree, metrics, BASE in names)


def _syntax_tree(text: str) -> ast.expr | None:
    """None for what is no expression."""
    if len(text) > LONGEST:
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
    raise AssertionError(f"{node} was let through")


def _unreadable(text: str) -> SemvizError:
    shown = text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
    return SemvizError(
        f"--fail-if '{shown}': write a comparison of metrics and numbers with + - * / ( ), such as "
        "'median_rte_m > 1.05*base'"
    )


def _listed(metrics: Metrics) -> str:
    return ", ".join(metrics)

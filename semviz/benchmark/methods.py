"""Which methods there are, by name, and which of them can run here."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from semviz_core.errors import SemvizError
from semviz_core.evaluation import answers, peers
from semviz_core.evaluation.drive_answers import DRIVE_METHODS

Kind = Literal["single", "matched", "sequence"]
"""Of problems: single frames, single frames whose matches are given, and drives."""
KNOWN: dict[Kind, Mapping[str, Callable[[], Any]]] = {
    "single": {**answers.METHODS, **peers.METHODS},
    "matched": {**answers.MATCHED_METHODS, **peers.MATCHED_METHODS},
    "sequence": DRIVE_METHODS,
}


@dataclass(frozen=True)
class Chosen:
    """Methods by kind of problem, and those left out, with why."""

    by_kind: dict[Kind, tuple[str, ...]]
    left_out: dict[str, str]

    def notes(self) -> list[str]:
        return [f"{name} is left out: {reason}" for name, reason in self.left_out.items()]


def choose_methods(text: str | None, kinds: set[Kind]) -> Chosen:
    """The methods of ``--methods a,b`` (None: all) that answer problems of ``kinds``."""
    known = {kind: named for kind, named in KNOWN.items() if kind in kinds}
    names = dict.fromkeys(name for named in known.values() for name in named)
    wanted = list(names) if text is None else [name.strip() for name in text.split(",")]
    if unknown := [name for name in wanted if name not in names]:
        raise SemvizError(
            f"--methods: no method {', '.join(unknown)} for these suites; known: {', '.join(names)}"
        )
    left_out: dict[str, str] = {}
    by_kind: dict[Kind, tuple[str, ...]] = {}
    for kind, named in known.items():
        here = [name for name in dict.fromkeys(wanted) if name in named]
        left_out |= {name: reason for name in here if (reason := _obstacle(kind, name))}
        by_kind[kind] = tuple(name for name in here if name not in left_out)
    chosen = Chosen(by_kind, left_out)
    if not any(by_kind.values()):
        raise SemvizError(f"--methods: nothing can run here; {'; '.join(chosen.notes())}")
    return chosen


@cache
def make_method(kind: Kind, name: str) -> Any:
    """The method, made once a process: a Method, MatchedMethod or DriveMethod."""
    return KNOWN[kind][name]()


def _obstacle(kind: Kind, name: str) -> str:
    """Why a method cannot run here; empty where it can."""
    try:
        make_method(kind, name)
    except ImportError as error:
        return f"its library is not installed ({error})"
    except SemvizError as error:
        return str(error)
    return ""

"""What an exchange could not keep, and what it had to assume: told to people and scripts."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

MOST_KINDS = 100
"""So many different things are told apart."""


@dataclass
class Tally:
    """How often each thing was dropped or assumed, by what it is and why."""

    dropped: "Counter[str]" = field(default_factory=Counter)
    assumed: "Counter[str]" = field(default_factory=Counter)

    def drop(self, what: str, count: int = 1) -> None:
        _count(self.dropped, what, count)

    def assume(self, what: str, count: int = 1) -> None:
        _count(self.assumed, what, count)


@dataclass(frozen=True)
class ExchangeReport:
    """What an export wrote, or an import read."""

    path: str
    format: str
    counts: Mapping[str, int]
    """Of what was exchanged, such as ``poles``."""
    dropped: Mapping[str, int]
    """What could not be kept, and how often."""
    assumed: Mapping[str, int]
    """What was not known and had to be assumed, and how often."""

    @classmethod
    def of(
        cls, path: object, format_: str, counts: Mapping[str, int], tally: Tally
    ) -> "ExchangeReport":
        return cls(str(path), format_, dict(counts), dict(tally.dropped), dict(tally.assumed))

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        counts = ", ".join(
            f"{count} {what.removesuffix('s') if count == 1 else what}"
            for what, count in self.counts.items()
        )
        lines = [f"{self.path}: {counts} ({self.format})"]
        lines += [f"  dropped: {count} x {what}" for what, count in sorted(self.dropped.items())]
        lines += [f"  assumed: {count} x {what}" for what, count in sorted(self.assumed.items())]
        return "\n".join(lines)


def _count(counter: "Counter[str]", what: str, count: int) -> None:
    if count:
        known = what in counter or len(counter) < MOST_KINDS
        counter[what if known else "more kinds of things"] += count

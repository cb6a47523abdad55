"""What a rule has to say about elements of a map."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

Severity: TypeAlias = Literal["error", "warning", "hint"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "hint")
"""The worst first. An error cannot be right; a warning hardly ever is; a hint may well be."""


@dataclass(frozen=True)
class Finding:
    """One element, or several together, that a person should look at."""

    rule: str
    """Such as ``leaning pole``."""
    severity: Severity
    element_ids: tuple[int, ...]
    """Ids of map elements."""
    message: str
    """One sentence with numbers."""
    frame_index: int | None
    """A frame to look at; None where no frame shows it."""

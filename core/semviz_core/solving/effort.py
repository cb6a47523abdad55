"""How much a search tries before it answers."""

from typing import NamedTuple


class Effort(NamedTuple):
    """Limits of a search."""

    step_m: float = 3.6
    """Between places; fits converge from several times as far."""
    hypotheses: int = 500
    """Most that are rated, of each view."""
    polished: int = 150
    """Of these, so many are polished and rated again; with several views, fewer in each as fewer
    are started."""
    started: int = 16
    """Most that are paired and fitted once: so many of each view, or, if that is more, so many of
    all views together."""
    finished: int = 6
    """Most that are fitted to the end."""
    improved: int = 3
    """So many of the best are tried without each of their pairs."""
    hopeful_nats: float = 30.0
    """What is lower than the best by more is not followed further."""


USUAL = Effort()
"""Enough behind an ordinary GPS fix."""
WIDE = Effort(hypotheses=1200, polished=600, started=64, finished=40, improved=6)
"""Finds what there is behind a fix 50 m off, in clutter or without gravity, for about twice the
time; which of it is right is another question."""

"""Short names that tell run files apart."""

from collections.abc import Sequence
from pathlib import Path


def run_names(paths: Sequence[Path]) -> list[str]:
    """File names without ending, with as many folders before them as tell them apart."""
    whole = [path.resolve().with_suffix("").parts for path in paths]
    names = [parts[-1] for parts in whole]
    depth = 1
    while len(set(names)) < len(set(whole)):
        depth += 1
        names = ["/".join(parts[-depth:]) for parts in whole]
    return names

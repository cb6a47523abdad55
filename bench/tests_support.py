"""Puts tests/ on the path, so that a bench can import ``support``."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))

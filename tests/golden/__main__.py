"""``python -m golden make|check|fixtures [G1 G4 ...]``; see the package."""

import os

# The last bits of a sum depend on how many threads share it; the values were made with one.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from golden.runner import main

main()

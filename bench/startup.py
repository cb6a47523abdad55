"""Start-up time, time to make the demo, and install size.

    python bench/startup.py

Prints one line per figure. Times are wall times of whole processes on an otherwise idle machine.
"""

import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

REPEATS = 7


def seconds(command: list[str], environment: dict[str, str] | None = None) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=environment)
    return time.perf_counter() - start


def median_seconds(command: list[str]) -> float:
    return statistics.median(seconds(command) for _ in range(REPEATS))


def demo_seconds() -> float:
    with tempfile.TemporaryDirectory() as cache:
        make = "from semviz.workspace.demo import ensure_demo; ensure_demo()"
        environment = {**os.environ, "XDG_CACHE_HOME": cache}
        return seconds([sys.executable, "-c", make], environment)


def installed_megabytes() -> dict[str, float]:
    """Size of semviz's run-time dependencies, by distribution."""
    sizes: dict[str, float] = {}
    pending = ["semviz"]
    while pending:
        name = pending.pop().lower()
        if name in sizes:
            continue
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # needed on another platform only
        paths = [Path(str(distribution.locate_file(file))) for file in distribution.files or ()]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6
        needs = [need for need in distribution.requires or () if "extra ==" not in need]
        pending += [re.split(r"[\s\[<>=!~;(]", need, maxsplit=1)[0] for need in needs]
    return sizes


def main() -> None:
    semviz = str(Path(sys.executable).parent / "semviz")
    print(f"semviz --help            {median_seconds([semviz, '--help']):7.2f} s")
    print(f"python -c 'pass'         {median_seconds([sys.executable, '-c', 'pass']):7.2f} s")
    print(f"making the demo          {demo_seconds():7.1f} s")
    sizes = installed_megabytes()
    print(f"install size             {sum(sizes.values()) / 1000:7.2f} GB in {len(sizes)} packages")
    for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:6]:
        print(f"    {name:<20} {size:7.0f} MB")


if __name__ == "__main__":
    main()

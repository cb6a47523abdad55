"""Time to render a stereo pair of the simulated street, and a sheet of examples.

python bench/street_rendering.py [SHEET.png] [--seed 1] [--frames 24]
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sheet", nargs="?", type=Path, help="contact sheet to write (PNG)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=24)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    street = Street(arguments.seed, StreetOptions(frames=arguments.frames))
    print_times(street)
    if arguments.sheet is not None:
        write_sheet(arguments.seed, arguments.sheet)


def print_times(street: Street) -> None:
    """Wall and processor time of each stereo pair, textures made beforehand."""
    street.image(0, "left")
    walls, busy = [], []
    for frame in street.frames:
        wall, cpu = time.perf_counter(), time.process_time()
        street.image(frame.index, "left")
        street.image(frame.index, "right")
        walls.append(time.perf_counter() - wall)
        busy.append(time.process_time() - cpu)
    for name, times in (("wall", walls), ("processor", busy)):
        median, late = np.percentile(np.array(times) * 1000.0, (50, 95))
        print(f"{name} time of a stereo pair: median {median:.0f} ms, p95 {late:.0f} ms")


def write_sheet(first_seed: int, path: Path) -> None:
    """Left and right pictures of four streets, one a row."""
    rows = []
    for seed in range(first_seed, first_seed + 4):
        street = Street(seed)
        rows.append(np.hstack([street.image(12, "left"), street.image(12, "right")]))
    sheet = cv2.resize(np.vstack(rows), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()

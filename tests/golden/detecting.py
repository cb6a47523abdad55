"""G8: what the detector that ships finds in simulated images, and how sure it is of the places."""

from pathlib import Path
from typing import Any

from golden.canonical import digest
from golden.command import run
from golden.files import table_content
from semviz import Workspace
from semviz_core.detection.detector import load_detector
from semviz_core.research.paper.method import measure_as_in_paper

SEED, IMAGES = 40_001, 20
PAPER = 5
"""Images that are measured as the paper does it, too."""


def golden_values(folder: Path) -> dict[str, Any]:
    """Of each image its regions and elements, and what the command keeps of all."""
    run(folder, "new", "street", "--simulate", SEED, "--frames", f"0:{IMAGES}")
    street = Workspace.open(folder / "street").street
    edges, paper = load_detector(), load_detector(measure=measure_as_in_paper)
    found: dict[str, Any] = {}
    for index in range(IMAGES):
        image = street.image(index, "left")
        regions, elements = edges.model.find(image), edges.detect(image)
        found[f"image {index}"] = {
            "image": digest(image),
            "regions": [len(regions), digest(regions)],
            "elements": [len(elements), digest(elements)],
            "sigma": digest(elements.sigma_px),
        }
        if index < PAPER:
            found[f"image {index}, paper"] = digest(paper.detect(image))
    run(folder, "detect", "street", "--sides", "left", "--frames", f"0:{PAPER}")
    found["proposals"] = table_content(folder / "street" / "proposals.parquet")
    return found

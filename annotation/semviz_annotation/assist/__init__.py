"""Image evidence for labels: snap a mark, match it in stereo, propagate it to other frames.

`marked_image` pairs an image with its camera and marks. `appearance` compares image patches.
`snap` improves one mark, `whole_pole` finds a pole under one point, and `stereo_matching` the
correspondence in the other image. `propagation` finds a mapped element in other frames, from its
`expected_position`: `pole_search` and `sign_search` search one image each (`image_search`), and
`track` tells how far a mark that follows others is trusted; `whole_ends` looks for a pole beyond
the ends of its mark.
`detection_refinement` does the same for detections, with `pole_ends` at their ends. `score`
turns the evidence into a probability.
"""

from semviz_annotation.assist.detection_refinement import (
    RawDetection,
    RefinedDetection,
    refine_detection,
)
from semviz_annotation.assist.image_search import ReferenceView
from semviz_annotation.assist.marked_image import SURE, Mark, MarkedImage, ProposedMark
from semviz_annotation.assist.propagation import propagate
from semviz_annotation.assist.snap import Snapped, snap
from semviz_annotation.assist.stereo_matching import (
    ImageCorrespondences,
    find_correspondence,
    stereo_pairs,
)

__all__ = [
    "SURE",
    "ImageCorrespondences",
    "Mark",
    "MarkedImage",
    "ProposedMark",
    "RawDetection",
    "ReferenceView",
    "RefinedDetection",
    "Snapped",
    "find_correspondence",
    "propagate",
    "refine_detection",
    "snap",
    "stereo_pairs",
]

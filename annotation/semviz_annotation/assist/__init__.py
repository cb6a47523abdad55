"""What the images say about a mark: snap it, find its partner, follow it into other frames."""

from semviz_annotation.assist.follow import Sight, follow
from semviz_annotation.assist.pairs import stereo_pairs
from semviz_annotation.assist.partner import Partners, find_partner
from semviz_annotation.assist.settle import Found, Settled, settle
from semviz_annotation.assist.shot import SURE, Mark, Proposed, Shot
from semviz_annotation.assist.snap import Snapped, snap

__all__ = [
    "SURE",
    "Found",
    "Mark",
    "Partners",
    "Proposed",
    "Settled",
    "Shot",
    "Sight",
    "Snapped",
    "find_partner",
    "follow",
    "settle",
    "snap",
    "stereo_pairs",
]

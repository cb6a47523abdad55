"""What the images say about a mark: snap it, find its partner, follow it into other frames."""

from semviz_annotation.assist.follow import follow
from semviz_annotation.assist.partner import Partners, find_partner
from semviz_annotation.assist.shot import SURE, Mark, Proposed, Shot
from semviz_annotation.assist.snap import Snapped, snap

__all__ = [
    "SURE",
    "Mark",
    "Partners",
    "Proposed",
    "Shot",
    "Snapped",
    "find_partner",
    "follow",
    "snap",
]

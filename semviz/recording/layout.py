"""Where things are in a run file: the one place that writer and reader share."""

FORMAT_VERSION = 3
"""2: priors hold the road. 3: what is paired under each pose of the search, steps of refinement.
Older versions are read, newer ones refused."""
APPLICATION = "semviz"
"""One application id for all runs: rerun keeps one layout of views for all of them."""

EXACT = "/semviz"
"""Below it are the exact numbers; everything else is for rerun's eyes, but for the images."""
INFO, MAP, FRAME, END = f"{EXACT}/info", f"{EXACT}/map", f"{EXACT}/frame", f"{EXACT}/end"
STRUCTURE = "structure"
"""The component that holds the codec's JSON."""

CAMERA = "/map/camera_estimate"
IMAGE = f"{CAMERA}/image"
RIGHT_CAMERA = f"{CAMERA}/right"
IMAGE_RIGHT = f"{RIGHT_CAMERA}/image"
"""Where a run was recorded with the images of both cameras."""

"""Where things are in a run file: the one place that writer and reader share."""

FORMAT_VERSION = 2
"""2: priors hold the road. Older versions are read, newer ones refused."""
APPLICATION = "semviz"
"""One application id for all runs: rerun keeps one layout of views for all of them."""

EXACT = "/semviz"
"""Below it are the exact numbers; everything else is for rerun's eyes, but for the images."""
INFO, MAP, FRAME, END = f"{EXACT}/info", f"{EXACT}/map", f"{EXACT}/frame", f"{EXACT}/end"
STRUCTURE = "structure"
"""The component that holds the codec's JSON."""

CAMERA = "/map/camera_estimate"
IMAGE = f"{CAMERA}/image"

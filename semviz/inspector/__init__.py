"""The tool behind ``semviz serve``: see why a frame failed."""

"""semviz serve: see why a frame failed."""

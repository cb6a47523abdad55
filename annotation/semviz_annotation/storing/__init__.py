"""The label file: an append-only log of operations, its state, and what keeps both safe."""

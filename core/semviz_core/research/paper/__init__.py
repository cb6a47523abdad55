"""Reproduce the paper's method (Chen, Xue, Pang, RA-L 2022): matcher, PnPL, training.

`method` measures a frame's regions, and takes the `matcher`'s P to a coarse pose and weighted PnPL.
The `matcher` makes P by graph features and optimal transport (in `matcher_torch` for training). For
learning, `weighted_pnpl` gives the pose with its gradient, and `training` defines the losses.
"""

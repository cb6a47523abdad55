"""Reproduce the paper's method (Chen, Xue, Pang, RA-L 2022): matcher, PnPL, training.

A frame passes through `measurement` of its regions, then the `matcher`: graph features (in
`graph_torch` for training) and optimal `transport` give P. `method` takes P to a coarse pose
and weighted PnPL. For learning, `weighted_pnpl` and `pnpl_layer` give the pose with its
gradient, and `training` defines the losses.
"""

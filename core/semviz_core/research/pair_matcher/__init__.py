"""Train the pair matcher, the network of the method `correspondences`.

Inference and geometry are in `semviz_core.localization.correspondences`. `network` is the network
in torch, with batches of the geometry, and `training` trains it, through the pose of weighted PnPL
too. Results are exact under padding.
"""

"""Train the pair matcher, the network of the method `correspondences`.

Inference and geometry are in `semviz_core.localization.correspondences`. `prepared` batches the
geometry, `network` is the network in torch, and `training` trains it. Results are exact under
padding. `pose_layer` differentiates the pose of weighted PnPL with the prior by P.
"""

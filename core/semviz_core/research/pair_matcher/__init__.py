"""Train the pair matcher, the network of the method `correspondences`.

Inference and geometry are in `semviz_core.localization.correspondences`. `network` is the network
in torch, with batches of the geometry. `training` trains it, and has the layer of weighted PnPL
that `bench/joint_training.py` trains through. Results are exact under padding.
"""

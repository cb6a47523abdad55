"""Train the pair matcher, the network of the method `correspondences`.

Inference and geometry are in `semviz_core.localization.correspondences`. `network` is the network
in torch, with batches of the geometry, and `training` trains it. The layer of weighted PnPL there is
what `bench/joint_training.py` trains through. Results are exact under padding.
"""

"""Learned correspondences of one frame, and the poses that couples of them imply.

`sample` turns a frame into numbers about the prior's position. `candidate_pairs` forms pairs
that the prior does not rule out, and `couples` takes them by twos: an upright minimal sample,
so a pose each. `pose_support` fits such poses and tells which pairs agree. `network` is the
trained network's forward pass in NumPy, and `matcher` runs it: P, with dustbins. It
also takes the couples of the surest pairs, and orders their poses by the consensus of P. The search
(`semviz_core.localization.search`) makes modes of them.
"""

"""2D3D-MatchNet and DeepI2P, as the paper compares itself with them.

The paper (Chen, Xue, Pang, RA-L 2022) gives both the detected and the mapped elements as points,
in place of patches, scans and pixels; it does not say how. `methods` defines one reading of each
and takes the matches to a pose (`epnp`), `networks` are their torch networks, small, and `training`
their losses. DeepI2P also runs from pixels and scans: `pixel_methods`, `pixel_network` and
`pixel_training`, with its solvers in `frustum`.
"""

"""2D3D-MatchNet and DeepI2P for mapped elements, as the paper compares itself with them.

The paper (Chen, Xue, Pang, RA-L 2022) gives both the detected and the mapped elements as points,
in place of patches, scans and pixels; it does not say how. `methods` defines one reading of each
and takes the matches to a pose, `networks` are their torch networks, small, and `training` their
losses.
"""

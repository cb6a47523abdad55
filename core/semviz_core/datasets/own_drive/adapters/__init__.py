"""Adapters: one file for each layout of recordings, which makes a ``Recording`` of it.

`registry` recognizes the layout. `euroc`, `kitti` (raw and KITTI-360), `nuscenes`, `argoverse2` and
`boreas` name images where they are; `rosbag` copies those of a bag to files. `comma2k19` reads
poses only.
"""

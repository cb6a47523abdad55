"""Adapters: make a ``Recording`` of the layout in which others publish or record drives.

`data_sets` recognizes the layout, and reads EuRoC, Boreas, Argoverse 2 and the poses of comma2k19.
`kitti` reads KITTI raw and KITTI-360, `nuscenes` nuScenes. These name images where they are;
`rosbag` copies those of a bag to files, with `ros_messages`.
"""

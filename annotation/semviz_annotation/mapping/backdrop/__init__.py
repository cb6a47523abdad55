"""Make a dense coloured backdrop of a drive from its stereo images and poses.

`stereo_depth` matches a stereo pair densely. `depth_fusion` back-projects the depths that other
frames confirm, and thins them. `backdrop` is the result with what it was made from, and its
file. Only `depth_fusion` needs open3d, and only while it runs.
"""

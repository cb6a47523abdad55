"""Read a drive recorded by any camera: a folder of images, a calibration and poses.

`image_files` lists images and their times. `calibration_files` reads cameras (`lens`), and
`pose_files` poses, with `colmap_model` and `nerfstudio` for files that hold both. `conventions`
applies what the poses mean: their direction, axes and body. `time_matching` gives each image a
pose, and `world_axes` turns them z up. `rectification` makes images of a pinhole camera, which
`image_folder` serves as a ``Dataset``.
"""

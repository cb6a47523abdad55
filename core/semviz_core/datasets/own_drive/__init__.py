"""Read a drive recorded by any camera: a folder of images, a calibration and poses.

`recording` names the files and options, and holds what they bring. `image_files` lists images and
their times; `calibration_files` and `named_calibrations` read cameras (`calibration`, `lens`),
`pose_files` poses, those with named columns by `pose_tables` from a `sensor_table`; `colmap_model`
holds both. `conventions` applies what poses mean: direction, axes, body, the upward axis of their
world. `recorded_cameras` and `recorded_drive` put it together. `rectification` makes images of a
pinhole camera, which `image_folder` serves as a ``Dataset``; `match_checks` measures on matches
whether rows agree, `pose_remedies` whether poses do, and what they would agree with.
"""

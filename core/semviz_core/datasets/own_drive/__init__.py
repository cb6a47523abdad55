"""Read a drive recorded by any camera: a folder of images, a calibration and poses.

`drive_files` names the files and options. `image_files` lists images and their times;
`calibration_files` reads cameras (`lens`, `yaml_files`) and `pose_files` poses; `colmap_model` and
`nerfstudio` hold both. `conventions` applies what poses mean: direction, axes, body, the upward
axis of their world. `recorded_cameras` and `recorded_drive` put it together, with `time_matching`.
`rectification` makes images of a pinhole camera, which `image_folder` serves as a ``Dataset``;
`row_check` and `convention_check` measure on matches (`matching`) whether rows and poses agree.
"""

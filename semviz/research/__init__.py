"""Train and evaluate networks from workspaces, and report detectors.

`training_run` runs a training with `matcher_data` or `detector_data` from workspaces.
`detector_evaluation` measures a detector on images with known content, and `detector_report`
shows the result with `detection_crops` of its errors. The subpackage `benchmark` compares
localization methods.
"""

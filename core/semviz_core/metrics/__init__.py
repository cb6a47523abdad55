"""Measure pose errors, image errors and detection quality.

`pose_errors` compares poses with ground truth and summarizes a run. `image_errors` compares
poles and signs in an image. `detection` matches detections with true elements, and
`detection_summary` turns the matches into recall, precision and sigma calibration.
"""

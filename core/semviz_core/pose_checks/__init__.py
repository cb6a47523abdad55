"""Check the poses of a drive, and its stereo calibration, against its images; refine them.

`tracks` follows points from frame to frame, `motion` measures the camera's motion from them, and
`image_motions` does that for a drive and keeps the result. `comparison` gives the innovations of
given poses. `whole_drive` explains them by one cause, `refinement` moves the poses, and `faults`
names what is wrong. Nothing here reads a label or changes a pose that others use.
"""

"""Find out why a frame, or a whole run, failed.

`reference` pairs a frame with the pose it is compared with. `checks` compares every detection
and map element with that pose, and `frame` checks the stages of localization in order, up to the
first that failed. Over a run, `run` collects recurring faults, `calibration` finds a wrong camera
calibration, and `element_statistics` counts detections and outliers of each map element. `fault`
defines the values they return.
"""

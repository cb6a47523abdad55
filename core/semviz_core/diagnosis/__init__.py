"""Find out why a frame, or a whole run, failed.

`reference` pairs a frame with the pose it is compared with. `checks` compares every detection
and map element with that pose, and `frame` checks the stages of localization in order, up to the
first that failed. Common causes come first: `assumptions` tests priors, `detection_sigma` the
stated sigmas and `alignment` the map as a whole; `solve_again` solves the frame without one of
them. Over a run, `run_causes` tests what all frames have in common, `calibration` finds a wrong
camera calibration, `run` collects recurring faults, and `element_statistics` counts detections
and outliers of each map element. `fault` defines the values they return.
"""

"""Find out why a frame, or a whole run, failed.

`reference` pairs a frame with the pose it is compared with. `checks` compares every detection
and map element with that pose, and `frame` checks the stages of localization in order, up to the
first that failed. Common causes come first: `assumptions` tests priors, `frame_causes` the stated
sigmas and the map as a whole. Over a run with true poses, `common_causes` says how map, mounting,
time and camera change all residuals, `cause_fits` finds the likeliest, and `odometry` tests the
motion. Without, `carried_poses` gives poses to most frames, `joint_solution` fits them together,
and `joint_fit` finds the likeliest cause. `run_causes` phrases causes with the frames that they
fix, `run` collects recurring faults, `detector_rates` estimates the detector's, and
`element_statistics` counts detections and outliers of each map element. `fault` defines the values
they return.
"""

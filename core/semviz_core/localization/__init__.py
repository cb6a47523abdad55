"""Estimate the pose of one frame, with its covariance and a status.

`request` checks the input and `problem` converts it to records for compiled code. `upright`
takes gravity out, `heading_votes` proposes poses around the prior's position by `voting`, `rating`
scores them, and `search` pairs and fits the best ones: the modes. Fitting rests on `residuals`,
`prior_residuals`, `association` and `least_squares`. `refinement` computes the best mode's
optimum and covariance, `mode_verifier` estimates how likely each mode is right, and `status`
decides whether the pose is reliable. `localizer` runs these stages; `rig` does for all cameras of
a rig (`camera_views`), whose joint problem is `rig_problem`. `noise_estimate` learns the sigmas of
detections over the frames of a run. The subpackage
`correspondences` learns correspondences, and proposes poses from them. The subpackage `matched`
solves frames whose correspondences are given.
"""

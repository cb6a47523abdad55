"""Read and validate sequences and trajectories, and simulate priors.

`kitti` reads frames, images and calibration; `trajectory` reads and writes poses as text.
`validation` checks them before they are used. `priors` simulates GPS, compass and inertial
measurements from the true poses.
"""

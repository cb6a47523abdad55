"""Localize a sequence: an extended Kalman filter with several hypotheses.

`tracker` processes one frame at a time. `belief` is the state, the pose together with the
errors of map elements. `ekf` moves it by odometry, `association` pairs a frame's observations
under it, and `ekf` applies the update. While the pose is undecided, `tracker` keeps several
beliefs side by side until one is reliable.
"""

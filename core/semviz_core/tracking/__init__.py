"""Localize a sequence: an extended Kalman filter with several hypotheses.

`tracker` processes one frame at a time. `association` defines the belief, the pose together with
the errors of map elements, and pairs a frame's observations under it. `ekf` moves the belief by
odometry and applies the update. While the pose is undecided, `tracker` keeps several beliefs side
by side until one is reliable.
"""

"""Localizing a drive: odometry and frames together, one belief from frame to frame."""

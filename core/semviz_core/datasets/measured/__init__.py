"""Read what a vehicle's own sensors measured: fixes, headings, gravity and odometry.

`table` reads tables whose columns have names. `poses_of` reads files of poses, and moves either to
the camera and into the map. `priors` gives the prior of a moment, and `odometry` the motion
between two.
"""

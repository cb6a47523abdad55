"""From labels to a map: build, decisions and their review; the paper's map for comparison.

`build` runs `association` and `placement`. `decisions` describes what was decided and what a
person can answer. `quality` checks and compares maps. `depth_fusion` makes the dense coloured
points of a drive from its stereo images and poses, and `backdrop` is their file.
"""

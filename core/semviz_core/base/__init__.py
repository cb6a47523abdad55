"""Define the values that all other packages exchange.

Geometry comes first: `pose` (rigid transforms), `camera` (pinhole cameras and rigs). `classes`
names the kinds of element, `elements` holds observed and mapped ones, `semantic_map` the whole
map and `map_file` its file. `frame` describes one moment of a sequence with its prior and
odometry, `localization` the result for it. `detector_model` holds the rates, noise and calibration
of a detector, and `weights` a trained network. All values are immutable.
"""

"""Measure poles and signs in an image to a fraction of a pixel.

`sampling` interpolates colours between pixels. For a pole, `pole_axis` finds and fits the axis
near a line, and `pole_ends` finds the ends along it. For a sign, `sign_outline` fits the outline,
which gives the centre. Detection and label assistance both use these measurements.
"""

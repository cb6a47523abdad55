"""Read a drive recorded by any camera: a folder of images, a calibration and poses.

`recording` names the files and options, and holds what they bring; `recorded_drive` puts it
together. `cameras` reads calibrations and lenses, `images` lists images and their times, and makes
those of a pinhole camera, `poses` reads poses and applies what they mean: direction, axes, body,
the upward axis of their world. `checks` measures on the images whether all of it agrees, and what
poses would agree with. `adapters` know the recordings and data sets of others.
"""

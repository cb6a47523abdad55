"""Cameras of a drive: calibration files, lenses, and models that hold both cameras and poses."""

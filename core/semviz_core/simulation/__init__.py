"""Simulate a street: its layout, its stereo images, its detections and its ground truth.

`layout` builds `objects` beside a road, and `street` drives a camera along it. `street` is the
Dataset. It paints an image with `drawing`, in this order: `ground`, `scenery`, then `furniture`
from far to near, and knows which elements an image shows. `detector` gives the true elements and
regions of an image, and simulated detections. `lidar` scans the same objects.
"""

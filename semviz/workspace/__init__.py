"""Work on a workspace folder: detect, localize, rebuild, review.

`workspace` defines the folder and its files. `detect` fills it with proposals, and
`observations` returns what labels, a detector or a simulated detector observe in a frame.
`localization` localizes a sequence from these observations and records a run, and repeats it with
edited labels. `drive`, `poses` and `maps` check what was imported and built, and keep what people
decided on it. `demo` makes a workspace with known faults.
"""

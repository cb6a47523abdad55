"""Work on a workspace folder: detect, localize, rebuild, review.

`workspace` defines the folder and its files. `detect` fills it with proposals, and
`observations` returns what labels, a detector or a simulated detector observe in a frame.
`localize` localizes a sequence from these observations and records a run. `rebuild` repeats map
and run with edited labels, `localizability` predicts errors along the route, and `map_review`
lists open decisions. `demo` makes a workspace with known faults.
"""

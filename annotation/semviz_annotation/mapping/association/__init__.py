"""Decide which label elements are observations of one landmark.

`tracks` runs the stages. `nodes` splits label elements into parts with the review decisions,
and `outliers` finds misplaced labels. `candidates` finds and tests pairs of nodes, and
`merging` joins them in rounds. `shared_observations` assigns what several landmarks explain,
and `candidates` drops landmarks with too few observations.
"""

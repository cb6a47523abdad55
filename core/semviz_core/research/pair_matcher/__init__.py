"""A learned matcher over candidate pairs of observed and mapped elements.

`candidates` forms pairs that the prior does not rule out. `couples` takes them by twos as pose
hypotheses, and `network` lets them vote for a pose. `inference` runs it on one frame and
`training` trains it. Results are exact under padding.
"""

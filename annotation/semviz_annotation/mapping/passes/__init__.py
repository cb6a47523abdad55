"""A map over time: what several passes of localized cameras say about each of its elements.

`evidence` counts in which frames of a pass an element should be seen, and was. `candidates`
triangulates what no element explains, and joins it over the passes. `existence` turns the counts
of all passes into probabilities, and `changes` names what vanished, appeared and moved, and makes
the changed map.
"""

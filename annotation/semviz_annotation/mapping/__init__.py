"""From labels to a map: build, decisions and their review; the paper's map for comparison.

`build` runs `association` and `placement`. `decisions` describes what was decided and what a
person can answer. `quality` checks and compares maps.
"""

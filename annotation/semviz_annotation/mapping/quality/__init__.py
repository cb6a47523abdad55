"""Quality of a map: accuracy, leave-one-out residuals, lint rules, and comparison of two maps.

`check` finds labels that disagree with the others, and prints it all. `label_links` associates
labels with map elements, `lint` runs the rules of `lint_rules` on a `lint_context`, and `diff`
compares two maps.
"""

"""Quality of a map: accuracy, leave-one-out residuals, lint rules, and comparison of two maps.

`check` prints it all. `label_links` associates labels with map elements, `leave_one_out` finds
labels that disagree with the others, `lint` runs the rules of `lint_rules` on a `lint_context`, and
`diff` compares two maps.
"""

"""Solve recorded frames again with changes, from the run file alone.

`change` defines a change and the request of one frame. `prior_changes` and `request_changes` are
the kinds of change.
`solve` applies a set of them to one frame or to a whole run.
"""

"""One map from the maps of several drives, whose poses each have errors of their own.

`merge` is the overview. `corrections` says how the errors of a drive's poses vary along its way,
`shift_votes` finds which elements of two drives are one landmark, `alignment` estimates the
corrections from these.
"""

"""Set benchmark problems with known poses, and compare methods on them.

`roads` supplies drives with the poles beside them, and errors of their maps. `problems` makes
localization problems there, `sequences` strings of them with odometry, `matched_problems` those
with given matches, `street_frames` those with a picture and a cloud. `methods` and `baselines`
solve them, and `outcomes` measures errors and summarizes them in rows.
"""

"""Decide which label elements are observations of one landmark.

`tracks` runs the stages. `nodes` splits label elements into parts with the review decisions.
`candidates` finds and tests pairs of nodes, and `merging` sets misplaced labels apart and joins
nodes in rounds. `shared_observations` assigns what several landmarks explain, and `candidates`
drops landmarks with too few observations.

`detection_tracks` adds the detections of a drive to the labels. `detected_drive` tells which of
them the labels explain, and `not_landmarks` which show no landmark. The others become
`ground_rays`, in which `track_search` finds tracks by the compiled loops of `ray_votes`; ends
that do not agree are dropped, and so are the tracks of what was left out.
"""

"""The label state, its edits, and the proposals of a detector.

`rows` are the stored records, held in `labels` over a `shared_dict`. `edits` and
`element_edits` compute row changes from that state. `proposals` holds detector output, filled
by `detections`. `views` gives the camera and pose of an image.
"""

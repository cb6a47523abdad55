"""Labels in the formats of CVAT, labelme and COCO, in and out.

A reader (`coco`, `cvat`, `labelme`) parses a file with the helpers in `reading`. `import_plan`
compares the result with the existing labels, and `exchange` applies the plan as one operation.
Export runs from `exchange` through `writing`, which also keeps the keys that only the other tool
understands. `table` writes a CSV that also has the pixels of recorded images. `numbers` shifts
coordinates by half a pixel without losing digits.
"""

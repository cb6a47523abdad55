"""Labels in the formats of CVAT, labelme and COCO, in and out.

A reader (`coco`, `cvat`, `labelme`) parses a file with the helpers in `reading`, which also shift
coordinates by half a pixel without losing digits. `import_context` finds the workspace's class and
image of a shape, and `shapes` makes a pole or sign of it. `exchange` compares the result with the
existing labels, and applies the plan as one operation. Export runs from `exchange` through
`writing`, which also keeps the keys that only the other tool understands, and writes a CSV with the
pixels of recorded images.
"""

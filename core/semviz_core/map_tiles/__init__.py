"""A map in tiles: square cells of the ground, each in a map file of its own, in versions.

`manifest` is the list of the tiles of one version, which is published as a whole. `publish` writes
those tiles that no earlier version has. `tiled_map` reads what is around a place.
"""

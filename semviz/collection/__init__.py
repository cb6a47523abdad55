"""Collections: many drives, and one map of them in tiles.

`collection` names the drives' workspaces, in a folder or an object store that holds the map's
tiles, too. Several people and processes may use one collection at once. `drive_map` is the part of
the map around a drive.
"""

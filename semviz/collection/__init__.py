"""Collections: many drives, and one map of them in tiles.

`collection` names the drives' workspaces and the versions of the map, in a folder or an object
store. Several people and processes may use one collection at once.
"""

"""Maps in the formats of other tools, in and out; see docs/map-formats.md.

`reading` and `writing` help the modules of single formats. `georeference` converts map metres to
WGS84. `exchange` imports and exports by file name.
"""

"""Maps in the formats of other tools, in and out; see docs/map-formats.md.

`conversion` helps the modules of single formats. `georeference` converts map metres to WGS84.
`exchange` imports and exports by file name.
"""

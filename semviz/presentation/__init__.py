"""Define the common appearance of all pages, reports and terminals.

`palette` holds colours, `plots` the style of plots, `tables` tables in several formats, and
`progress` progress bars. Nothing here loads data.
"""

"""Define the common appearance of all pages, reports and terminals.

`plots` holds colours and the style of plots, `terminal` tables in several formats and progress
bars. Nothing here loads data.
"""

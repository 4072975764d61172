"""Compare runs in a table and an image (docs/compare.md).

`runs` reads the folders of the runs, `common` selects the views that all runs can render, `figures` and
`parts` build the table, `terminal` prints it, `sheet` draws the image, and `write` is the entry point.
"""

"""The report of a run: one HTML file that loads nothing from outside (docs/report.md).

`files` and `measured` read the run's folder; `views`, `surface` and `light` render its model; `pictures`,
`tables` and `curves` produce HTML with the elements of `markup`; `page` combines the sections; `write` is the
entry point.
"""

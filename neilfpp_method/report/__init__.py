"""What a run came to, on one page that needs no network (docs/report.md), and runs beside one another.

`files` reads what lies in the run's folder, `views`, `surface` and `light` make pictures from its model, `sections` and `page`
write them down as HTML. `comparison` does the same for several runs.
"""

"""What a run came to, on one page that needs no network (docs/report.md).

`files` reads what lies in the run's folder, `views`, `surface` and `light` make pictures from its model;
`pictures` and `tables` put them into HTML, `page` frames it, and `write` does it all.
"""

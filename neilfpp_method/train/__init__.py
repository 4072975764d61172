"""Train a run from a capture.

`command` is `neilfpp train`. It opens or plans a run (`request`, `opening`; with a time budget `budgeted`,
`trial` and `pace`), reads the pixels (`reading`), builds the model (`build`, `start`), and calls the `loop`,
whose state is a `training`. Within the loop `evidence` measures effects and fits the light, and `quality` and
`preview` show how good the result is.

A run is a folder (`run`) with checkpoints (`checkpoint`) and records, each in a module of its own
(`budget_record`, `effects_record`, `health_record`, `light_record`, `work_record`, `provenance`). Steps that
were not finite are stored (`skipped`) and can be run again (`rerun`, `first_not_finite`).
"""

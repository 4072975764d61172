"""Whether a run is sound: what goes wrong without an error, likely causes, remedies (docs/health.md).

`look` measures what a model shows of some training pixels, `cases` turns measurements into findings, and
`watch` follows a training.
"""

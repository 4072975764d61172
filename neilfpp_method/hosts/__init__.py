"""Geometry and radiance: what the method needs from the model that it runs on.

`base` is the contract, and `capabilities` lists its optional part. Hosts of this package are `volsdf` and
`mesh`, with R and the background from `radiance`.

Hosts of other projects are recognised by `adapt` (a `function`, a `nerfstudio` model, whole images by
`image`) and wrapped by `foreign`, with a `proxy` for rays that they cannot trace. Their batches and outputs
are converted and checked (`batches`, `conversion`, `outputs`, `first_batches`). `testing` checks a host for
its author.
"""

"""Fit an environment map and near lamps to observed surface points.

The outgoing radiance of a surface is linear in the texels of the map and in the intensities of the lamps.

`solver` is what training loops call: it remembers surface points (`memory`) and what cameras saw of the map
(`sky`), and lets `solve` find the light. `solve` computes the transport to the points (`fit_points`,
`map_transport`, `lamp_transport`), minimises the terms of `objective` (`fit`, `descent`), and chooses lamps
(`candidates`, `settle`) if held-back points favour them (`decision`). `layered_transport` has the transport
at several roughnesses, from which `effects` finds materials.
"""

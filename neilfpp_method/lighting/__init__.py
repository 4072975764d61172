"""Fit an environment map and near lamps to observed surface points.

The outgoing radiance of a surface is linear in the texels of the map and in the intensities of the lamps.
"""

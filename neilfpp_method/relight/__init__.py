"""A finished run under other light, by path tracing on the surface and with the material that it has
found.
"""

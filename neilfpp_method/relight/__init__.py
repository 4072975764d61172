"""A finished run under other light, path-traced on the surface and material that it has found."""

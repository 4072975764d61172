"""A finished run under other light: a path tracer on the surface that was found, with the material that was found."""

"""Render a finished run under other light, by path tracing on its surface with its material."""

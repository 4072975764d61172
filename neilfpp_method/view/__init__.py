"""The viewer in the browser. Only `browser` and `session` import viser."""

"""The pixels of a capture: store them, draw them with their rays, and tell the object from the background."""

"""Inspect a capture: figures of its views, its defects, and the quality of its radiance."""

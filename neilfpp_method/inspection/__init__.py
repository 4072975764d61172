"""Inspect a capture: figures of its views, findings on defects, and a verdict on its radiance."""

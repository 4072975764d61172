"""Detect trainings that go wrong without an error, with likely causes and remedies (docs/health.md).

`measure` renders some training pixels and measures the surface and the material, `cases` derives findings
from the measurements, and `watch` collects the findings during a training.
"""

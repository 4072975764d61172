"""Detect trainings that go wrong without an error, with likely causes and remedies (docs/health.md).

`look` takes measurements at some training pixels, `cases` derives findings from them, and `watch` collects
the findings during a training.
"""

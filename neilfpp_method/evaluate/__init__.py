"""Measure a run: metrics, evaluation protocols, expected errors, and images beside the truth."""

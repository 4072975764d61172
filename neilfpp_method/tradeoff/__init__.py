"""Measure accuracy against training time, with a run for each of several time budgets."""

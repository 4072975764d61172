"""Faults planted one at a time in a copy of the package, and which quick test notices each.

`faults` and `later_faults` list the faults, `planting` plants each and runs its tests, and `table` writes the
results into docs/stability.md. `python -m benchmarks.mutants` does all of this.
"""

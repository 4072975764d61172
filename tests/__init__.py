"""The tests. In all modules that are imported after them, shapes are checked as `shape_checks` says."""

from tests.shape_checks import check_some_calls

check_some_calls()

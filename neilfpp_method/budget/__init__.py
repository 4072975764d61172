"""Plan a training for a time budget. These are pure functions: they measure nothing and write nothing."""

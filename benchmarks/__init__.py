"""Measurements that take minutes: each a command whose output goes into docs/."""

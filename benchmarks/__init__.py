"""Measurements that take minutes; each is a command whose output is shown in docs/."""

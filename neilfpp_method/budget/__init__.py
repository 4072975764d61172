"""A training that is planned for a time: numbers in, plan out. Nothing here measures, waits or writes."""

"""Measure time by kind of work: code marks its work, and a ledger that listens adds up the seconds."""

"""Measure time by kind of work: code marks its work, and an active ledger adds up the seconds."""

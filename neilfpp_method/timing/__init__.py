"""Where the time of a computation goes: code says what it is doing, and a ledger that listens keeps the
seconds.
"""

"""Where time goes: code says what it is doing, and a ledger that listens adds up the seconds."""

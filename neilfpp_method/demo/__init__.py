"""The example capture of the package, and the command that trains on it."""

"""Readers and writers of the capture layouts of other projects, one module each."""

"""Layouts that others write, each read, and some written, by a module of its own."""

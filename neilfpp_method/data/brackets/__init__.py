"""Exposure brackets: find, align and merge photographs of several exposures."""

"""All settings: `types` declares them, `presets` gives them values, and `check` rejects impossible ones.

`plain` converts them to and from plain values, `files` reads them from YAML and JSON, and `facts` has what is
measured in the images in place of being set.
"""

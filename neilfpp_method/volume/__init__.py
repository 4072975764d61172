"""Volume rendering: where a ray meets the scene, how dense it is there, where to sample it, how to add it
up.
"""

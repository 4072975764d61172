"""The viewer in the browser. Only `browser` knows viser; everything else works, and is tested, without
one.
"""

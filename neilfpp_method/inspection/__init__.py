"""What is in a capture, and what is wrong with it: figures of each view, of views together, findings and a
verdict.
"""

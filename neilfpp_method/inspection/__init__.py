"""What is in a capture, and what is wrong with it: figures of views, findings and a verdict."""

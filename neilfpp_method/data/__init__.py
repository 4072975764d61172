"""Captures in: readers, images, point clouds, the pixel dataset and the ground truth."""

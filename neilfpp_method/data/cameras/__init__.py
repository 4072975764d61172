"""Cameras: intrinsics, lens distortion, projection, and the import of COLMAP."""

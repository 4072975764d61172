"""The four fields G, R, B and L and the background, with their encodings and networks (METHOD §5)."""

"""The four fields of the method and the background, with their encodings and networks (METHOD §5)."""

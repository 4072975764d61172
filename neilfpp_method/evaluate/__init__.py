"""What a run is worth: metrics, the protocols that put them together, pictures and reports."""

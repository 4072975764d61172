"""Places: surface points with their pixels in many views, to which light and materials are fitted."""

"""Volume rendering: where a ray meets the scene, its density there, where to sample, how to add up."""

"""Volume rendering: intersection with the scene sphere, density, samplers along rays, and compositing."""

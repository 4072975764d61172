"""What accuracy costs in time: one run for each budget, measured, put beside each other."""

"""Random and evenly spaced numbers on intervals, one in each of equal parts."""

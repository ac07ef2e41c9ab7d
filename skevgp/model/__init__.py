"""The mathematics of the model: statistics of the rows, bounds, prediction. Pure functions of arrays."""

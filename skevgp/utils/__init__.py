"""Tools that are independent of Gaussian processes."""

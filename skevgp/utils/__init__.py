"""Tools that know nothing of Gaussian processes."""

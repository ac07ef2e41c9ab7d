"""Models of the noise."""

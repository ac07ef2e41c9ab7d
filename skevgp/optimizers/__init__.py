"""Minimisers that know no Gaussian process."""

"""Weights that all outputs share, from logs: what rows are worth that follow each other, and standing friction."""

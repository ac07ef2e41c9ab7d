"""Noise with a Student-t's tails."""

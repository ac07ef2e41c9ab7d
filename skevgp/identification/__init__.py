"""Identification of robots from logs: weights that all joints share, static friction, and payloads."""

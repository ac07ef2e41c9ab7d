"""Identification of robots from logs: inertial parameters, friction, payloads and contact."""

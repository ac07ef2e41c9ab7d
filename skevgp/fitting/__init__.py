"""Decisions: where a fit starts, what it tries, when it ends, what the user is told."""

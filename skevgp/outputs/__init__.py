"""Several outputs: which of them share what, their fits, and what is kept of these."""

"""Fitted models as CasADi functions and as C: for optimal control, and for machines without Python."""

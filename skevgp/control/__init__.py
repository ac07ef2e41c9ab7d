"""Requests of controllers to a fitted model: fast predictions, sampled functions, rollouts, CasADi and C code."""

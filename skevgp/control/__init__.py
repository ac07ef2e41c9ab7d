"""What controllers ask of a fitted model: fast rows, sampled functions, rollouts, CasADi and C code."""

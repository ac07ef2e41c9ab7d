"""A transformer as a function of one row: its value, its Jacobian, its CasADi expression."""

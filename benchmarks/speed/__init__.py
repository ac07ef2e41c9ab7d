"""What an evaluation of the bound costs, how time and memory grow with rows, and whether another checkout is faster."""

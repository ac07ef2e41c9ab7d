"""Each library as a peer: a model at fixed hyperparameters, by which libraries are compared, and its fit."""

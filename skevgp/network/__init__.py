"""The Bayesian network's loss and training."""

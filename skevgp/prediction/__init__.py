"""What is done with a fitted model beyond `predict`: derivatives, rollouts, predictions without validation."""

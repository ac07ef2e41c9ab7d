"""What is done with a fitted model beyond `predict`: derivatives, and predictions without validation."""

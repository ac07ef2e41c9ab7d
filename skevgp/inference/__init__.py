"""The mathematics: statistics, bounds, posterior and optimisers. Knows no estimator and no robot."""

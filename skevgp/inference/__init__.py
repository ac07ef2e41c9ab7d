"""The mathematics: statistics, bounds, objectives, posterior. Knows no estimator and no robot."""

"""The regressors: arguments, documentation and fitted attributes."""

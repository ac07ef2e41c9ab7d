"""Data for other packages' ways with a regressor. (These tests run where they are named, with the extra `clients`.)"""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def data():
    """Rows of two columns with noise of 0.1."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (300, 2))
    return X, np.sin(2.0 * X[:, 0]) + 0.5 * X[:, 1] + 0.1 * rng.randn(300)

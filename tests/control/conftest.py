"""Data and fitted models for the tests of what is done with a fitted model."""

from functools import cache

import numpy as np
import pytest
from sklearn.base import clone

from .cases import MODELS, D, quick


@cache
def rows():
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (120, D))
    Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1], np.cos(X.sum(axis=1))])
    return X, Y + 0.05 * rng.randn(*Y.shape), rng.uniform(-2.0, 2.0, (9, D))


@cache
def fitted(name):
    """Fitted once for all files."""
    X, Y, _ = rows()
    return quick(clone(MODELS[name])).fit(X, Y)


@pytest.fixture
def data():
    return rows()


@pytest.fixture(params=MODELS)
def model(request):
    return fitted(request.param)

"""A small problem as an estimator hands it over: rows in the user's units, units, and how they are fitted."""

import numpy as np

from skevgp.data.rows import LocalSource, Moments, RawRows
from skevgp.data.threads import BlockMap
from skevgp.fitting.fit import fit_model
from skevgp.fitting.inducing import Placement
from skevgp.fitting.parts import models_of
from skevgp.fitting.problem import Problem
from skevgp.fitting.units import LeastSquares, Units
from skevgp.kernels.parse import parse_kernel
from skevgp.model.predictor import CoefficientPrior
from skevgp.utils.monitor import Monitor

_rng = np.random.RandomState(0)
N, O = 60, 2  # noqa: E741
X = _rng.uniform(-2.0, 2.0, (N, 2))
H = np.column_stack([np.ones(N), X[:, 0]])
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], 50.0 * np.cos(X[:, 1]) * X[:, 0]])
Y += [1.0, 50.0] * (0.05 * _rng.randn(N, O)) + [3.0, 0.0]
NO_FEATURES = H[:, :0]
COEF_MEAN, COEF_SCALE = np.array([[0.5, 0.0], [0.0, 10.0]]), np.array([[2.0, 1.0], [50.0, 100.0]])


def source_of(X=X, H=H, Y=Y):
    return LocalSource.holding(RawRows(X, H, Y))


def units_of(X=X, H=H, Y=Y, target_mean=0.0):
    """With both features, or with none if H has no columns."""
    o, p = Y.shape[1], H.shape[1]
    mean, scale = (own[np.arange(o) % 2, :p] for own in (COEF_MEAN, COEF_SCALE))
    prior = CoefficientPrior(mean, scale, np.zeros((o, p)))
    source = source_of(X, H, Y)
    rows = LeastSquares.of(source, np.broadcast_to(target_mean, o))
    return Units.of(source, Moments.of(H), Moments.of(Y), rows, prior)


def data_of(Y, X=X):
    """Targets without features."""
    H = np.empty((len(X), 0))
    return {"X": X, "H": H, "Y": Y, "units": units_of(X, H, Y)}


def problem_of(X=X, H=H, Y=Y, kernel=None, n_inducing=8, **changes):
    """What an estimator asks for."""
    units = changes.pop("units", None) or units_of(X, H, Y)
    options = {
        "source": source_of(X, H, Y),
        "units": units,
        "spec": parse_kernel(kernel, X.shape[1]),
        "vague": np.zeros(units.prior.scale.shape, dtype=bool),
        "shapes": (X.shape[1:], H.shape[1:]),
        "weight_names": tuple(f"h{j}" for j in range(H.shape[1])),
        "placement": Placement("k-means", n_inducing),
        "max_iter": 20,
        "tol": 1.0,
    }
    return Problem(**options | changes)


def models(monitor=None, seed=0, previous=None, **changes):
    """The models of a problem, each to be fitted."""
    monitor = Monitor() if monitor is None else monitor
    return models_of(problem_of(**changes), np.random.RandomState(seed), monitor, BlockMap(), previous)


def model_of(monitor=None, seed=0, **changes):
    """The one model of a problem whose outputs share everything."""
    (model,) = models(monitor, seed, **changes)
    return model


def fitted(monitor=None, seed=0, previous=None, **changes):
    monitor = Monitor() if monitor is None else monitor
    return fit_model(problem_of(**changes), np.random.RandomState(seed), monitor, previous)

"""The bounds written down from the data in plain autograd.numpy: no statistics, no blocks, no hand-written gradient."""

from functools import partial
from types import SimpleNamespace

import autograd.numpy as anp
import numpy as np

from skevgp.data.blocks import LocalBlocks
from skevgp.data.dataset import Dataset
from skevgp.data.rows import LocalSource, Moments, RawRows, Rows, block_of
from skevgp.fitting.search import Rules
from skevgp.fitting.start import starting_table
from skevgp.kernels.parse import Start, Starts
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.bounds import LOG_2PI
from skevgp.model.model import SparseModel
from skevgp.model.predictor import CoefficientPrior


def at_the_fit(model, X, y):
    """Model, blocks of all rows, and parameters."""
    (fitted,) = model._fitted.models
    rows = model._fitted.units.rows(Dataset.further(model, model._posterior.maps, X, y).source)
    return fitted, fitted.sparse.blocks(rows, fitted.values["inducing_points"].shape[1])


def central_differences(function, x, step=1e-6):
    return np.array([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))])


def relative_error(actual, expected):
    return np.abs(actual - expected).max() / np.abs(expected).max()


def squared_exponential(A, B, lengthscales):
    return anp.exp(-0.5 * anp.sum(((A[:, None, :] - B[None, :, :]) / lengthscales) ** 2, axis=2))


def whitened(lengthscales, Z, X):
    """L and V = L⁻¹ k(Z, X)."""
    K = squared_exponential(Z, Z, lengthscales)
    # The points of `problem` lie apart: K needs no jitter.
    L = anp.linalg.cholesky(K)
    return L, anp.linalg.solve(L, squared_exponential(Z, X, lengthscales))


def collapsed_bound(lengthscales, signal, noise, Z, rows, prior, family="full"):
    """Summed over outputs; Z (g, m, d) with g = 1 or one set per output."""
    total = 0.0
    for o in range(len(prior.scale)):
        L, V = whitened(lengthscales, Z[o % len(Z)], rows.inputs)
        P = anp.concatenate([anp.sqrt(signal[o]) * V.T, rows.features * prior.scale[o]], axis=1)
        r = rows.residuals[:, o] + rows.features @ (prior.scale[o] * prior.reference[o])
        B = np.eye(P.shape[1]) + P.T @ P / noise[o]
        log_det = anp.linalg.slogdet(B)[1]
        quadratic = (r @ r - (P.T @ r) @ anp.linalg.solve(B, P.T @ r) / noise[o]) / noise[o]
        trace = signal[o] * anp.sum(1.0 - anp.sum(V**2, axis=0)) / noise[o]
        total = total - 0.5 * (len(rows) * anp.log(2 * np.pi * noise[o]) + log_det + quadratic + trace)
        if family == "diagonal":
            m = len(L)
            T = anp.linalg.inv(L)
            precision = T.T @ B[:m, :m] @ T
            diagonal = anp.concatenate([anp.diag(precision), anp.diag(B)[m:]])
            log_det_precision = log_det - 2.0 * anp.sum(anp.log(anp.diag(L)))
            total = total - 0.5 * (anp.sum(anp.log(diagonal)) - log_det_precision)
    return total


def dense_bounds(lengthscales, signal, noise, Z, rows, prior):
    """Lower bound, log marginal likelihood and upper bound from (N, N) matrices, summed over outputs."""
    N, bounds = len(rows), np.zeros(3)
    for o in range(len(prior.scale)):
        points = Z[o % len(Z)]
        U = squared_exponential(points, rows.inputs, lengthscales)
        K = signal[o] * squared_exponential(rows.inputs, rows.inputs, lengthscales)
        Q = signal[o] * U.T @ np.linalg.solve(squared_exponential(points, points, lengthscales), U)
        linear = rows.features @ np.diag(prior.scale[o] ** 2) @ rows.features.T
        r, t = rows.residuals[:, o] + rows.features @ (prior.scale[o] * prior.reference[o]), np.trace(K - Q)

        def log_density(determinant_of, inverse_of, r=r):
            log_det = np.linalg.slogdet(determinant_of)[1]
            return -0.5 * (N * np.log(2.0 * np.pi) + log_det + r @ np.linalg.solve(inverse_of, r))

        exact, sparse = K + linear + noise[o] * np.eye(N), Q + linear + noise[o] * np.eye(N)
        bounds[0] += log_density(sparse, sparse) - 0.5 * t / noise[o]
        bounds[1] += log_density(exact, exact)
        bounds[2] += log_density(sparse, sparse + t * np.eye(N))
    return bounds


class ArrayRows:
    """Rows in internal units whose arrays a test can look at."""

    def __init__(self, inputs, features, residuals):
        self.inputs, self.features, self.residuals = inputs, features, residuals

    def __len__(self):
        return len(self.inputs)

    def blocks(self, kernel, size, **options):
        raw, make = (
            RawRows(self.inputs, self.features, self.residuals),
            partial(block_of, kernels=(kernel,), to_internal=lambda raw: raw),
        )
        return LocalBlocks(lambda rows: make(raw[rows]), len(self), 6, size=size, **options)


def identity_rows(inputs, residuals):
    """Rows whose internal units are the user's."""
    return Rows(LocalSource.holding(RawRows(inputs, np.empty((len(inputs), 0)), residuals)), lambda raw: raw)


def table_of(inputs, points, starts, scatter, n_hyperparameters, rules=Rules(1e-2), **options):  # noqa: B008
    """The parameters of a model of rows with such inputs, whose internal units are the user's."""
    none = np.zeros(len(scatter))
    units = SimpleNamespace(target_unit=none + 1.0, constant=none > 0.0, rounding=none, target_scatter=none + 1.0)
    spec = SimpleNamespace(starts=starts, covariance=SimpleNamespace(n_hyperparameters=n_hyperparameters))
    rows = SimpleNamespace(
        inputs=Moments.of(inputs), columns=slice(None), mean_precision=1.0, scatter=lambda: np.asarray(scatter)
    )
    return starting_table(SimpleNamespace(units=units, spec=spec, rules=rules), rows, points, **options)


def problem(family="full", shared=True, n=60, m=6, d=2, o=2, p=3, seed=0):
    """A small model, its rows and a table of parameters away from any optimum."""
    rng = np.random.RandomState(seed)
    X, H = rng.randn(n, d), rng.randn(n, p)
    Y = np.sin(X @ rng.randn(d, o)) + H @ rng.randn(p, o) + 0.1 * rng.randn(n, o)
    prior = CoefficientPrior(np.zeros((o, p)), 0.5 + rng.rand(o, p), 0.3 * rng.randn(o, p))
    rows = ArrayRows(X, H, Y - H @ prior.offset.T)
    groups = (slice(0, o),) if shared else tuple(slice(i, i + 1) for i in range(o))
    model = SparseModel(SquaredExponential(d), prior, family, groups)
    Z = np.array([X[rng.choice(n, m, replace=False)] + 0.1 * rng.randn(m, d) for _ in groups])
    starts = Start(0.8 + rng.rand(d)), Start(0.5 + rng.rand(o)), Start(0.1 + 0.1 * rng.rand(o))
    return model, rows, table_of(X, Z, Starts(*starts), np.ones(o), d)


def negative_elbo(statistics, signal, noise, prior, mean, root, log_det):
    """The paper's loss (its eq. elbo, with C free where q is a joint Gaussian), summed over outputs.

    Written in autograd.numpy: it can be traced through every argument but ``prior``, and so is the oracle of the
    hand-written gradient in `elbo`.

    Parameters
    ----------
    statistics : SufficientStatistics
        Of all rows, or of a mini-batch scaled to all rows (the paper's appendix C, times N), with a leading axis of
        length 1 (inducing points common to all outputs) or o where they depend on the inducing points.
    signal, noise : array of shape (o,)
        s² and σ².
    prior : CoefficientPrior
    mean : array of shape (o, m + p)
        Mean of q(ω), whitened: (L⁻¹ a / s, (b - μ_β) / c - w₀).
    root : array of shape (o, m + p, m + p)
        Any R with covariance of q(ω) = R Rᵀ.
    log_det : array of shape (o,)
        log |R Rᵀ|.

    Returns
    -------
    loss : float
        In nats.
    """
    o, p = prior.scale.shape
    m = mean.shape[1] - p
    own = np.arange(o) if len(statistics.VV) == o else np.zeros(o, dtype=int)
    s = anp.sqrt(signal)[:, None]
    cross = s[:, :, None] * (statistics.VH * prior.scale[:, None, :])
    HH = prior.scale[:, :, None] * statistics.HH * prior.scale[:, None, :]
    VV = signal[:, None, None] * statistics.VV
    PP = anp.concatenate(
        [anp.concatenate([VV, cross], axis=2), anp.concatenate([anp.swapaxes(cross, 1, 2), HH], axis=2)], axis=1
    )
    Pr = anp.concatenate([s * statistics.VR[own, :, np.arange(o)], prior.scale * statistics.HR.T], axis=1)
    # All of σ⁻² (eᵀe + Tr(PP R Rᵀ)) as one trace: Tr(PP (R Rᵀ + mean meanᵀ)).
    spread = anp.concatenate([root, mean[:, :, None]], axis=2)
    squares = anp.sum(anp.matmul(PP, spread) * spread, axis=(1, 2)) - 2.0 * anp.sum(Pr * mean, axis=1) + statistics.RR
    data = statistics.n_rows * (LOG_2PI + anp.log(noise)) + (squares + signal * statistics.unexplained) / noise
    shift = mean + np.hstack([np.zeros((o, m)), prior.reference])
    divergence = anp.sum(root**2, axis=(1, 2)) + anp.sum(shift**2, axis=1) - (m + p) - log_det
    return 0.5 * anp.sum(data + divergence)

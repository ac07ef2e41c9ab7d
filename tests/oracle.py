"""The bounds written down from the data in plain autograd.numpy: no statistics, no blocks, no hand-written gradient."""

from dataclasses import dataclass, replace
from functools import partial

import autograd.numpy as anp
import numpy as np

from skevgp.data.blocks import LocalBlocks
from skevgp.data.dataset import Dataset
from skevgp.data.rows import LocalSource, RawRows, Rows, block_of
from skevgp.fitting.problem import Problem
from skevgp.fitting.rules import RULES, Rules
from skevgp.fitting.start import starting_table
from skevgp.fitting.units import Units
from skevgp.kernels.parse import Start, Starts, parse_kernel
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.bounds import LOG_2PI, Variant
from skevgp.model.left_out import LeftOut, Seen, sums_of_others
from skevgp.model.model import SparseModel
from skevgp.model.parameters import Parameter, ParameterTable
from skevgp.model.predictor import CoefficientPrior
from skevgp.model.statistics import collect


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


def own(values, o):
    """Of output o, if outputs have rows of their own (n, o, d)."""
    return values[:, o] if values.ndim == 3 else values


class Dense:
    """The model from (N, N) matrices, in autograd.numpy: y ~ N(H β, Q + σ² V) for each output, one below the other.

    Q is k(X, Z) k(Z, Z)⁻¹ k(Z, X) of inducing points Z, or with ``exact`` k(X, X). Values are those of the library's
    parameter tables. Row i has the weight w (`counts`) and the noise variance σ² v (`counts / precision`).
    """

    def __init__(self, rows, prior, family="full", exact=False, tight=False):
        self.X, self.H, targets = rows.inputs, rows.features, rows.targets
        ones = np.ones(len(self.X))
        self.counts = ones if rows.counts is None else rows.counts
        self.precision = ones if rows.precision is None else rows.precision
        self.prior, self.family, self.exact, self.tight = prior, family, exact, tight
        self.outputs = range(len(prior.scale))
        self.residuals = targets + self.linear(self.H, prior.offset - prior.mean)

    def linear(self, H, weights):
        return np.stack([own(H, o) @ weights[o] for o in self.outputs], axis=1)

    def by(self, values):
        """The factors (o, p) of the weights' scales."""
        if self.prior.groups is None:
            return np.ones(self.prior.scale.shape)
        factors = values["coef_factors"] * np.ones((len(self.outputs), 1))
        factors = anp.concatenate([factors, np.ones((len(self.outputs), 1))], axis=1)
        return factors[np.arange(len(factors))[:, None], self.prior.groups]

    def C(self, values):
        return self.prior.roots() * self.by(values)[:, :, None]

    def k(self, values, o, A, B):
        return values["signal"][o] * squared_exponential(A, B, values["hyperparameters"])

    def sparse_k(self, values, o, A, B):
        """What the inducing points know of k(A, B)."""
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        return self.k(values, o, A, Z) @ anp.linalg.solve(self.k(values, o, Z, Z), self.k(values, o, Z, B))

    @property
    def known_k(self):
        return self.k if self.exact else self.sparse_k

    def covariance(self, values, k, A, H_A, B, H_B):
        """Of all outputs of rows A and B: (o n_A, o n_B)."""
        C = self.C(values)

        def block(i, j):
            if i != j and not self.prior.shared:
                return np.zeros((len(A), len(B)))
            linear = own(H_A, i) @ C[i] @ C[j].T @ own(H_B, j).T
            return linear + k(values, i, own(A, i), own(B, i)) if i == j else linear

        return anp.concatenate([anp.concatenate([block(i, j) for j in self.outputs], axis=1) for i in self.outputs])

    def noise(self, values):
        return anp.concatenate([values["noise"][o] / self.precision for o in self.outputs])

    def total(self, values, k):
        return self.covariance(values, k, self.X, self.H, self.X, self.H) + anp.diag(self.noise(values))

    def log_density(self, values, S, wide=0.0):
        """Of the residuals, w times each: N(y | g, a)ʷ = N(y | g, a / w) (2πa)^(-(w - 1) / 2) w^(-1 / 2)."""
        r, w = self.residuals.T.ravel(), np.tile(self.counts, len(self.outputs))
        copies = (w - 1.0) @ anp.log(2.0 * np.pi * self.noise(values) * w) + np.log(w).sum()
        quadratic = r @ anp.linalg.solve(S + wide * np.eye(len(r)), r)
        return -0.5 * (len(r) * LOG_2PI + anp.linalg.slogdet(S)[1] + quadratic + copies)

    def likelihood(self, values):
        return self.log_density(values, self.total(values, self.k))

    def left(self, values):
        """Of each row's variance, what the inducing points do not explain, over its noise: of each output, times σ²."""
        inputs = [own(self.X, o) for o in self.outputs]
        left = (self.k(values, o, X, X) - self.sparse_k(values, o, X, X) for o, X in enumerate(inputs))
        return [self.precision / self.counts * anp.diag(each) for each in left]

    def traces(self, values):
        return [self.counts @ each for each in self.left(values)]

    def charge(self, values):
        """Twice the nats that the bound loses for what the inducing points do not explain."""
        over_noise = [self.counts * each / values["noise"][o] for o, each in enumerate(self.left(values))]
        n = np.maximum(self.counts, 1.0)
        return sum(anp.sum(n * anp.log(1.0 + each / n) if self.tight else each) for each in over_noise)

    def bound(self, values):
        """The lower bound of the family; the likelihood if the model is exact."""
        if self.exact:
            return self.likelihood(values)
        lost = self.charge(values) + self.gap(values)
        return self.log_density(values, self.total(values, self.sparse_k)) - 0.5 * lost

    def upper_bound(self, values):
        """Of rows that count once, and weights of each output."""
        total = 0.0
        for o in self.outputs:
            targets = self.residuals[:, [o]] + self.H @ (self.prior.mean - self.prior.offset)[[o]].T
            alone = Dense(RawRows(self.X, self.H, targets), self.prior.outputs([o]))
            names = ("signal", "noise", *(["coef_factors"] if self.prior.groups is not None else []))
            its = values | {name: values[name][[o]] for name in names}
            its["inducing_points"] = values["inducing_points"][[o % len(values["inducing_points"])]]
            total += alone.log_density(its, alone.total(its, alone.sparse_k), alone.traces(its)[0])
        return total

    # --- a diagonal q ---------------------------------------------------------------------------------------------

    def projected(self, values, o, A, H_A):
        """What g is of (f_m, β): (n, m + p)."""
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        return anp.hstack([anp.linalg.solve(self.k(values, o, Z, Z), self.k(values, o, Z, A)).T, H_A])

    def of_values_and_weights(self, values, o):
        """The posterior precision of (f_m, β)."""
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        A, p = self.projected(values, o, self.X, self.H), self.H.shape[1]
        K_inv, C_inv = (
            anp.linalg.inv(self.k(values, o, Z, Z)),
            anp.diag((self.prior.scale * self.by(values))[o] ** -2.0),
        )
        top = anp.hstack([K_inv, np.zeros((len(Z), p))])
        prior = anp.concatenate([top, anp.hstack([np.zeros((p, len(Z))), C_inv])])
        return prior + A.T @ (self.precision[:, None] / values["noise"][o] * A)

    def gap(self, values):
        """What the diagonal family loses, twice."""
        if self.family == "full":
            return 0.0
        precisions = (self.of_values_and_weights(values, o) for o in self.outputs)
        return sum(anp.sum(anp.log(anp.diag(each))) - anp.linalg.slogdet(each)[1] for each in precisions)

    # --- predictions ----------------------------------------------------------------------------------------------

    def predict(self, values, A, H_A):
        """Mean (n, o), and covariance (o n, o n) of noise-free rows; of a diagonal q the variances only (n, o)."""
        S, n = self.total(values, self.known_k), len(A)
        cross = self.covariance(values, self.known_k, A, H_A, self.X, self.H)
        mean = (cross @ np.linalg.solve(S, self.residuals.T.ravel())).reshape(-1, n).T + self.linear(
            H_A, self.prior.mean
        )
        prior = self.covariance(values, self.k, A, H_A, A, H_A)
        if self.family == "full":
            return mean, prior - cross @ np.linalg.solve(S, cross.T)
        known = [
            self.projected(values, o, A, H_A) ** 2 / np.diag(self.of_values_and_weights(values, o))
            for o in self.outputs
        ]
        left = [np.diag(self.k(values, o, A, A) - self.sparse_k(values, o, A, A)) for o in self.outputs]
        return mean, np.transpose([own.sum(axis=1) + rest for own, rest in zip(known, left, strict=True)])

    def weights(self, values):
        """Means (o, p) and covariances (o, p, p)."""
        C, S = self.C(values), self.total(values, self.known_k)
        means, covariances = [], []
        for o in self.outputs:
            each = [C[o] @ C[i].T @ own(self.H, i).T * float(i == o or self.prior.shared) for i in self.outputs]
            cross = np.hstack(each)
            means.append(self.prior.mean[o] + cross @ np.linalg.solve(S, self.residuals.T.ravel()))
            covariances.append(C[o] @ C[o].T - cross @ np.linalg.solve(S, cross.T))
            if self.family == "diagonal":
                m = len(values["inducing_points"][0])
                covariances[o] = np.diag(1.0 / np.diag(self.of_values_and_weights(values, o))[m:])
        return np.array(means), np.array(covariances)


class ArrayRows:
    """Rows in internal units whose arrays a test can look at."""

    def __init__(self, inputs, features, residuals):
        self.inputs, self.features, self.residuals = inputs, features, residuals

    def __len__(self):
        return len(self.inputs)

    @property
    def raw(self):
        return RawRows(self.inputs, self.features, self.residuals)

    def blocks(self, kernel, size, **options):
        return blocks_of(self.raw, kernel, size, **options)


def blocks_of(raw, kernel, size=17, **options):
    make = partial(block_of, kernels=(kernel,), to_internal=lambda rows: rows)
    return LocalBlocks(lambda rows: make(raw[rows]), len(raw.inputs), 6, size=size, **options)


def values_of(table, flat):
    """The parameters at coordinates of a table without hand-written code, for autograd."""
    c, points = table.coordinates(flat), table["inducing_points"]
    names = [own.name for own in table.parameters if own.transform == "log"]
    values = {name: anp.exp(c[name]) for name in names}
    return values | {"inducing_points": c["inducing_points"] * points.unit + points.origin}


def identity_rows(inputs, residuals):
    """Rows whose internal units are the user's."""
    return Rows(LocalSource.holding(RawRows(inputs, np.empty((len(inputs), 0)), residuals)), lambda raw: raw)


@dataclass(frozen=True)
class RuledProblem(Problem):
    """A problem with rules of the search that a test chooses."""

    rules: Rules = RULES


def table_of(inputs, points, starts, scatter, covariance, rules=Rules(1e-2), **options):  # noqa: B008
    """The parameters of a model of rows with such inputs, whose internal units are the user's."""
    residuals = np.linspace(-1.0, 1.0, len(inputs))
    rows = identity_rows(inputs, np.multiply.outer(residuals / residuals.std(), np.sqrt(scatter)))
    none = np.zeros((len(scatter), 0))
    zero, unit = np.zeros(len(scatter)), np.ones(len(scatter))
    units = Units(zero, unit, CoefficientPrior(none, none, none), unit, zero, zero > 0.0)
    spec = replace(parse_kernel(None, inputs.shape[-1]), covariance=covariance, starts=starts)
    shapes = inputs.shape[1:], (0,)
    return starting_table(
        RuledProblem(rows.source, units, spec, none > 0.0, shapes, rules=rules), rows, points, **options
    )


def problem(family="full", shared=True, n=60, m=6, d=2, o=2, p=3, seed=0):
    """A small model, its rows and a table of parameters away from any optimum."""
    rng = np.random.RandomState(seed)
    X, H = rng.randn(n, d), rng.randn(n, p)
    Y = np.sin(X @ rng.randn(d, o)) + H @ rng.randn(p, o) + 0.1 * rng.randn(n, o)
    prior = CoefficientPrior(np.zeros((o, p)), 0.5 + rng.rand(o, p), 0.3 * rng.randn(o, p))
    rows = ArrayRows(X, H, Y - H @ prior.offset.T)
    groups = (slice(0, o),) if shared else tuple(slice(i, i + 1) for i in range(o))
    model = SparseModel(SquaredExponential(d), prior, groups, Variant(family))
    Z = np.array([X[rng.choice(n, m, replace=False)] + 0.1 * rng.randn(m, d) for _ in groups])
    starts = Start(0.8 + rng.rand(d)), Start(0.5 + rng.rand(o)), Start(0.1 + 0.1 * rng.rand(o))
    return model, rows, table_of(X, Z, Starts(*starts), np.ones(o), model.kernel)


def with_groups(model, table):
    """The same with two groups of weights whose scales are learned, and weights whose scales stay."""
    (o, p), rng = model.prior.scale.shape, np.random.RandomState(5)
    groups = rng.randint(-1, 2, (o, p))
    # Correlated weights are in one group.
    groups = groups if model.prior.root is None else np.zeros((o, p), dtype=int)
    model = replace(model, prior=replace(model.prior, labels=("a", "b"), groups=groups))
    factors = Parameter("coef_factors", 0.5 + rng.rand(1 if model.prior.shared else o, 2), "log")
    return model, ParameterTable([*table.parameters, factors])


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
    shift = mean + anp.hstack([np.zeros((o, m)), prior.reference])
    divergence = anp.sum(root**2, axis=(1, 2)) + anp.sum(shift**2, axis=1) - (m + p) - log_det
    return 0.5 * anp.sum(data + divergence)


# --- rows of a problem, and its held-out rows -------------------------------------------------------------------------


def rows_of(rows, chosen, counts=None, precision=None):
    """Some rows whose internal units are the user's."""
    weights = (None, None) if counts is None else (counts[chosen], precision[chosen])
    raw = RawRows(rows.inputs[chosen], rows.features[chosen], rows.residuals[chosen], *weights)
    return Rows(LocalSource.holding(raw), lambda raw: raw)


def left_out(model, values, rows, folds, **weights):
    """For each group of outputs a LeftOut of each fold."""
    m, groups = values["inducing_points"].shape[1], []
    blocks = [model.blocks(rows_of(rows, fold, **weights), m) for fold in folds]
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        others = sums_of_others([collect(own, whitening, outputs) for own in blocks])
        seen = [own.sum(Seen(whitening, outputs)) for own in blocks]
        known = [model.group(values, outputs, whitening, sums) for sums in others]
        groups.append([LeftOut(group, model.variant.family, own) for group, own in zip(known, seen, strict=True)])
    return groups

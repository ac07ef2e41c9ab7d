"""Functions with parameters, and the likelihood of their parameters from dense matrices."""

import autograd.numpy as anp
import numpy as np
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.features import LogNormal, Normal, ParametricFeatures, Uniform

# --- functions -------------------------------------------------------------------------------------------------------


def wave(X, period, phase):
    return anp.sin(2.0 * np.pi * X[:, 0] / period + phase)


def decay(X, rate):
    return anp.exp(-rate * X[:, :1])


def wave_and_slope(X, period, phase):
    return anp.concatenate([anp.sin(2.0 * np.pi * X[:, :1] / period + phase), X[:, 1:2]], axis=1)


def rows_of_outputs(X, period, phase):
    """A row of two features for each of two outputs."""
    first = anp.sin(2.0 * np.pi * X[:, :1] / period + phase)
    one, other = anp.concatenate([first, X[:, 1:2]], axis=1), anp.concatenate([X[:, 1:2] ** 2, first], axis=1)
    return anp.concatenate([one[:, None, :], other[:, None, :]], axis=1)


def rows_of_three(X, scale):
    """A row of one feature for each of three outputs."""
    return anp.concatenate([anp.sin(scale * X[:, :1] * o)[:, None, :] for o in (1.0, 2.0, 3.0)], axis=1)


def line(X, a, b):
    return a * X[:, 0] + b * X[:, 1]


PRIORS = {"period": Uniform(1.0, 3.0), "phase": Normal(0.0, 0.5)}
WAVE = ParametricFeatures(wave, PRIORS)
DECAY = ParametricFeatures(decay, {"rate": LogNormal(1.0, 0.3)})

# --- data ------------------------------------------------------------------------------------------------------------

FIXED = ConstantKernel(0.3, "fixed") * RBF(0.8, "fixed") + WhiteKernel(0.01, "fixed")


def data(n=40, seed=0):
    """Rows of two columns, and two targets: waves of one period and phase, with discrepancy and noise."""
    rng = np.random.RandomState(seed)
    X = np.column_stack([np.linspace(0.0, 5.0, n), rng.uniform(-1.0, 1.0, n)])
    first = wave(X, 1.8, 0.3)
    Y = np.column_stack([2.0 * first + 0.3 * np.sin(3.0 * X[:, 0]), -0.5 * first + 0.2 * X[:, 0]])
    return X, Y + 0.1 * rng.randn(n, 2)


# --- the oracle ------------------------------------------------------------------------------------------------------


class DenseTheta:
    """log p(y, z) of a fitted model whose inducing points are all rows, with weights and f integrated out."""

    def __init__(self, model, X, Y):
        self.X, self.y = X, Y.reshape(len(X), -1).T.ravel()
        self.o = len(self.y) // len(X)
        self.features, self.priors = model.feature_map_, list(model.feature_map_.parameters.items())
        kernels = model.kernel_ if isinstance(model.kernel_, list) else [model.kernel_]
        noise = np.atleast_1d(model.noise_variance_)
        n = len(X)
        self.S = np.zeros((len(self.y), len(self.y)))
        for o, (kernel, variance) in enumerate(zip(kernels, noise, strict=True)):
            self.S[o * n : (o + 1) * n, o * n : (o + 1) * n] = kernel(X) + variance * np.eye(n)
        self.shared = self.o > 1 and model.coef_.ndim == 1
        self.mean, self.scale = (np.atleast_2d(own) for own in (model.coef_prior_mean_, model.coef_prior_scale_))

    def theta(self, z):
        return {name: prior.value(own) for (name, prior), own in zip(self.priors, z, strict=True)}

    def coordinates(self, theta):
        return np.array([prior.coordinate(theta[name]) for name, prior in self.priors])

    def H(self, z):
        """The features (o n, k) of all weights."""
        values = np.asarray(self.features.function(self.X, **self.theta(z))).reshape(len(self.X), -1)
        return np.vstack([values] * self.o) if self.shared else np.kron(np.eye(self.o), values)

    def __call__(self, z):
        H = self.H(z)
        L = np.linalg.cholesky(self.S + (H * self.scale.ravel() ** 2) @ H.T)
        r = np.linalg.solve(L, self.y - H @ self.mean.ravel())
        return -0.5 * (r @ r + z @ z) - np.log(np.diag(L)).sum()


def sampled(log_density, start, covariance, n_steps=6000, seed=0):
    """Draws of z by a random walk (Metropolis), with steps from the covariance of a guess."""
    rng, root = np.random.RandomState(seed), np.linalg.cholesky(covariance)
    z, value, draws = start, log_density(start), []
    for step in 2.4 / np.sqrt(len(start)) * rng.randn(n_steps, len(start)) @ root.T:
        there = log_density(z + step)
        if np.log(rng.rand()) < there - value:
            z, value = z + step, there
        draws.append(z)
    return np.array(draws[n_steps // 10 :])

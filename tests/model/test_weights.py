"""Likelihoods of weights and of parameters, against dense matrices and differences."""

from dataclasses import replace

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad, jacobian
from numpy.testing import assert_allclose

from skevgp.model.exact import ExactModel
from skevgp.model.predictor import CoefficientPrior
from skevgp.model.weights import Deviation, WeightLikelihood, information_root, likelihood_of_whitened, theta_step

from ..oracle import Dense, blocks_of, own
from .test_dense import O, setting

RNG = np.random.RandomState(4)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("n_groups", [1, 2])
def test_likelihoods_of_weights_are_dense_ones(n_groups, weighted):
    """Also with inducing points at all rows, and in the exact model."""
    model, raw, table = setting("full", n_groups, False, weighted, 3)
    values, dense = table.values_at_start(), Dense(raw, model.prior)
    everything = values | {"inducing_points": np.repeat(raw.inputs[np.newaxis], n_groups, axis=0)}
    exact = ExactModel(model.kernel, model.prior, np.zeros((O, 3), dtype=bool), raw)
    found = {}
    for name, at in {"sparse": values, "all": everything}.items():
        found[name] = model.weight_likelihoods(at, model.statistics(at, blocks_of(raw, model.kernel)))
    found["exact"] = exact.weight_likelihoods(values)
    for name, likelihoods in found.items():
        k = dense.sparse_k if name == "sparse" else dense.k
        for o, likelihood in enumerate(likelihoods):
            S = k(values, o, raw.inputs, raw.inputs) + np.diag(values["noise"][o] / dense.precision)
            # Residuals are those at the offset of the prior with its learned scales.
            r, H = raw.targets[:, o], own(raw.features, o)
            assert_allclose(likelihood.M, H.T @ np.linalg.solve(S, H), rtol=1e-6, atol=1e-8)
            assert_allclose(likelihood.h, H.T @ np.linalg.solve(S, r), rtol=1e-6, atol=1e-8)
            assert likelihood.q == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)


def test_likelihood_in_other_units():
    H, r = RNG.randn(9, 3), RNG.randn(9)
    found = likelihood_of_whitened(H, r).in_units(4.0)
    expected = likelihood_of_whitened(H / 4.0, r)
    for name in ("M", "h", "q", "sizes"):
        assert_allclose(getattr(found, name), getattr(expected, name))


class Bent:
    """Two outputs with three features, one of which has two parameters and one of which has one."""

    n, o, p, q = 30, 2, 3, 2
    columns = np.array([[0, 0], [0, 1], [2, 1]])

    def __init__(self, shared):
        rng = np.random.RandomState(2)
        self.x, self.y = rng.randn(self.n, self.o), rng.randn(self.n, self.o)
        roots = [np.tril(rng.randn(self.p, self.p)) for _ in range(self.o)]
        mean, reference = rng.randn(self.o, self.p), rng.randn(self.o, self.p)
        if shared:
            roots[1], mean[1], reference[1] = roots[0], mean[0], reference[0]
        root = np.array(roots)
        self.prior = CoefficientPrior(mean, np.sqrt((root**2).sum(axis=2)), reference, root, shared)
        each = [0.3 * rng.randn(self.n, self.n) for _ in range(self.o)]
        self.S = [A @ A.T + 0.5 * np.eye(self.n) for A in each]

    def H(self, z, o):
        x = self.x[:, o]
        return anp.stack([anp.sin(z[0] * x + z[1]), x, anp.exp(0.3 * z[1] * x)], axis=1)

    def likelihoods(self, z):
        found = []
        for o in range(self.o):
            D = jacobian(lambda z, o=o: self.H(z, o))(z)[:, self.columns[:, 0], self.columns[:, 1]]
            H, r = np.hstack([self.H(z, o), D]), self.y[:, o] - self.H(z, o) @ self.prior.offset[o]
            root = np.linalg.inv(np.linalg.cholesky(self.S[o]))
            found.append(likelihood_of_whitened(root @ H, root @ r))
        return found

    def step(self, z):
        return theta_step(self.likelihoods(z), self.prior, self.columns, z)

    def covariance(self, z):
        """Of all rows of all outputs, with weights integrated out."""
        H, C = [self.H(z, o) for o in range(self.o)], self.prior.roots()

        def block(i, j):
            common = H[i] @ C[i] @ C[j].T @ H[j].T
            return common + self.S[i] if i == j else float(self.prior.shared) * common

        return anp.concatenate([anp.concatenate([block(i, j) for j in range(self.o)], axis=1) for i in range(self.o)])

    def log_density(self, z):
        mean = anp.concatenate([self.H(z, o) @ self.prior.mean[o] for o in range(self.o)])
        total, r = self.covariance(z), self.y.T.ravel() - mean
        return -0.5 * (r @ anp.linalg.solve(total, r) + anp.linalg.slogdet(total)[1] + z @ z)


@pytest.mark.parametrize("shared", [False, True])
def test_step_is_slope_and_information_of_dense_density(shared):
    bent, z, other = Bent(shared), np.array([0.4, -0.7]), np.array([-0.2, 0.3])
    step = bent.step(z)
    assert step.value - bent.step(other).value == pytest.approx(bent.log_density(z) - bent.log_density(other), rel=1e-9)
    assert_allclose(step.gradient.sum(axis=0) - z, grad(bent.log_density)(z), rtol=1e-8)
    # Gauss-Newton: slopes of the mean at the posterior mean of the weights.
    J = np.vstack([jacobian(lambda z, o=o: bent.H(z, o) @ step.beta[o])(z) for o in range(bent.o)])
    precision = np.eye(2) + J.T @ np.linalg.solve(bent.covariance(z), J)
    assert_allclose(step.deviation().covariance, np.linalg.inv(precision), rtol=1e-8)
    assert_allclose(step.newton(), np.linalg.solve(precision, step.gradient.sum(axis=0) - z), rtol=1e-8)
    assert_allclose(step.deviation().std, np.sqrt(np.diag(np.linalg.inv(precision))), rtol=1e-8)
    # The offset of the new reference is the posterior mean.
    assert_allclose(replace(bent.prior, reference=step.reference).offset, step.beta, rtol=1e-10)


def test_priors_of_outputs_are_those_given_the_others():
    """In a model that is linear in z: the posterior from each prior is that of all, and so is the evidence."""
    q, each = 2, [(RNG.randn(9, 2), RNG.randn(9)) for _ in range(3)]
    fixed = CoefficientPrior(np.ones((3, 1)), np.zeros((3, 1)), np.zeros((3, 1)))
    z, columns = np.array([0.5, -0.3]), np.array([[0, 0], [0, 1]])
    likelihoods = [likelihood_of_whitened(np.hstack([A @ z[:, None], A]), y - A @ z) for A, y in each]
    step = theta_step(likelihoods, fixed, columns, z)

    def density(y, mean, covariance):
        return -0.5 * ((y - mean) @ np.linalg.solve(covariance, y - mean) + np.linalg.slogdet(covariance)[1])

    A, y = np.vstack([A for A, _ in each]), np.concatenate([y for _, y in each])
    together, apart = density(y, np.zeros(27), A @ A.T + np.eye(27)), 0.0
    precision = np.eye(q) + A.T @ A
    assert_allclose(z + step.newton(), np.linalg.solve(precision, A.T @ y), rtol=1e-9)
    for output, (A, y) in enumerate(each):
        mean, others = step.cavity(output)
        own_precision = np.linalg.inv(others.covariance) + A.T @ A
        assert_allclose(own_precision, precision, rtol=1e-9)
        r = np.linalg.solve(others.covariance, mean) + A.T @ (y - A @ z)
        assert_allclose(np.linalg.solve(precision, r), step.newton(), rtol=1e-8)
        apart += density(y, A @ (z + mean), A @ others.covariance @ A.T + np.eye(9))
    assert apart - together == pytest.approx(step.counted_twice(), rel=1e-9)


def test_directions_of_rounding_errors_are_no_information():
    """Information of 1e20 along one direction leaves the prior along the other, whatever its rounding errors."""
    along = np.array([3.0, -4.0, 0.0]) / 5.0
    information = 1e20 * np.outer(along, along) + np.diag([0.0, 0.0, 10.0])
    wrong = information + 1e4 * np.array([[-1.0, 0.5, 0.0], [0.5, -1.0, 0.0], [0.0, 0.0, 0.0]])
    F, projector = information_root(wrong, np.diag(information))
    assert_allclose(F.T @ F, information, rtol=1e-10)
    deviation = Deviation.of(F)
    across = np.array([4.0, 3.0, 0.0]) / 5.0
    assert across @ deviation.covariance @ across == pytest.approx(1.0, rel=1e-6)
    assert deviation.std[2] == pytest.approx(1.0 / np.sqrt(11.0))
    assert along @ deviation.covariance_times(1e10 * along) == pytest.approx(1e-10)
    assert_allclose(projector @ projector, projector, atol=1e-10)
    assert np.trace(projector) == pytest.approx(2.0)
    assert_allclose(projector @ along, along, atol=1e-10)
    assert_allclose(Deviation.of(np.zeros((2, 3))).covariance, np.eye(3))


def test_weights_whose_precision_is_a_rounding_error_are_factorised():
    """The difference of two large matrices may be negative."""
    M = np.array([[-10.0, 0.0], [0.0, 1.0]])
    likelihood = WeightLikelihood(M, np.zeros(2), 1.0, np.array([1e16, 1.0]))
    prior = CoefficientPrior(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    step = theta_step([likelihood], prior, np.array([[0, 0]]), np.zeros(1))
    assert np.isfinite(step.newton()).all()

"""Bayesian regression of all outputs on weights that they share, with the outputs' gains and the noise of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .rows_of_logs import correlation_time
from .stiction import JointNoise, likeliest_noise

# Noise, its correlation and gains settle in so many rounds.
_ROUNDS = 6
# Noise is at least this share of an output's variance.
_LEAST = 1e-12


@dataclass(frozen=True)
class Rows:
    """What is known of each row: y = (1 + c) ∘ (H β)_scaled + (H β)_others + ε, with weights β and gains 1 + c.

    Attributes
    ----------
    features : ndarray of shape (n, o, p)
        H, a row for each output.
    targets : ndarray of shape (n, o)
    speed : ndarray of shape (n, o)
        By which friction at rest is known (`JointNoise`).
    runs, blocks : ndarray of shape (n,)
        Labels of rows that follow each other, and of those that are left out together.
    """

    features: np.ndarray
    targets: np.ndarray
    speed: np.ndarray
    runs: np.ndarray
    blocks: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> Rows:
        return Rows(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Prior:
    """Of the weights, and of the gains behind them if these are unknown.

    Attributes
    ----------
    mean : ndarray of shape (P,)
        P is p, or p + o with gains.
    covariance : ndarray of shape (P, P)
    scaled : ndarray of bool of shape (p,)
        The weights that gains multiply: not friction, which is found in the units of what was measured.
    coulomb : ndarray of int of shape (o,), optional
        Which weight is Coulomb's friction of each output. None: nothing stands still.
    velocity : float
        Up to which friction has no sign.
    """

    mean: np.ndarray
    covariance: np.ndarray
    scaled: np.ndarray
    coulomb: np.ndarray | None
    velocity: float


@dataclass(frozen=True)
class Weights:
    """The posterior N(mean, covariance) of weights and gains.

    Attributes
    ----------
    mean, covariance : ndarray of shape (P,) and (P, P)
    prior : Prior
    noise : list of JointNoise
        Of each output.
    correlation_time : ndarray of shape (o,)
        Rows that say as much as one independent row.
    inflation : float
        By which the blocks differ more than that allows for, at least 1; the covariance knows of it.
    """

    mean: np.ndarray
    covariance: np.ndarray
    prior: Prior
    noise: list[JointNoise]
    correlation_time: np.ndarray
    inflation: float

    @property
    def n_weights(self) -> int:
        return len(self.prior.scaled)

    def gains(self, n_outputs: int) -> np.ndarray:
        """1 + c, (o,)."""
        c = self.mean[self.n_weights :]
        return 1.0 + (c if len(c) else np.zeros(n_outputs))

    def predict(self, features: np.ndarray) -> np.ndarray:
        """The mean (n, o) of rows of features (n, o, p)."""
        return _forward(features, self.mean, self.prior)

    def given(self, first: np.ndarray) -> Weights:
        """The same with the first weights elsewhere, and the others where they then most probably are."""
        n = len(first)
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        unit = np.where(scale > 0.0, scale, 1.0)
        correlation = self.covariance / np.outer(unit, unit)
        move = (first - self.mean[:n]) / unit[:n]
        mean = self.mean.copy()
        mean[:n] = first
        mean[n:] += unit[n:] * (correlation[n:, :n] @ np.linalg.lstsq(correlation[:n, :n], move, rcond=1e-10)[0])
        return replace(self, mean=mean)

    def variance(self, features: np.ndarray) -> np.ndarray:
        """What the weights' uncertainty adds to it, (n, o), to first order in the gains."""
        slopes, _ = _linearised(features, np.zeros(features.shape[:2]), self.mean, self.prior)
        return np.maximum(np.einsum("nop,nop->no", slopes @ self.covariance, slopes), 0.0)


def identify(rows: Rows, prior: Prior) -> Weights:
    """The posterior of the weights: exact given noise, its correlation and gains, which are found with it.

    The noise of output j counts as many times as `correlation_time` says, so that filtered rows are counted as what
    they are worth. What blocks of rows tell should then differ from each other as much as their information says: if
    the scores s_b = B_bᵀ e_b differ more, all of it is worth less by that ratio, ``inflation``.

    Parameters
    ----------
    rows : Rows
    prior : Prior

    Returns
    -------
    weights : Weights

    References
    ----------
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, Eq. 2.8: the posterior of a
      Bayesian linear model. Gains are linearised around their last value (Gauss-Newton).
    """
    y = rows.targets
    n_outputs = y.shape[1]
    root = _root(prior.covariance)
    size = np.where(y.var(axis=0) > 0.0, y.var(axis=0), np.max(y**2, axis=0))
    size = np.where(size > 0.0, size, 1.0)
    noise = [JointNoise(float(variance), 0.0, prior.velocity) for variance in size]
    times, mean = np.ones(n_outputs), prior.mean
    for _ in range(_ROUNDS):
        slopes, targets = _linearised(rows.features, y, mean, prior)
        errors = targets - slopes @ prior.mean
        scale = 1.0 / np.sqrt(_variances(noise, rows.speed) * times)
        B = (slopes * scale[:, :, np.newaxis]) @ root
        z = _solve(B.reshape(-1, len(root)), (errors * scale).ravel())[0]
        mean = prior.mean + root @ z
        left = y - _forward(rows.features, mean, prior)
        coulomb = np.zeros(n_outputs) if prior.coulomb is None else np.abs(mean[prior.coulomb])
        noise = [
            _noise_of(left[:, o], rows.speed[:, o], float(coulomb[o]), last, _LEAST * float(size[o]))
            for o, last in enumerate(noise)
        ]
        spread = np.sqrt(_variances(noise, rows.speed))
        times = np.array([correlation_time(errors, rows.runs) for errors in (left / spread).T])
    scale = 1.0 / (spread * np.sqrt(times))
    slopes, targets = _linearised(rows.features, y, mean, prior)
    B = (slopes * scale[:, :, np.newaxis]) @ root
    errors = (targets - slopes @ prior.mean) * scale
    z, covariance = _solve(B.reshape(-1, len(root)), errors.ravel())
    inflation = _inflation(B, errors - B @ z, covariance, rows.blocks)
    if inflation > 1.0:
        weight = inflation**-0.5
        z, covariance = _solve(weight * B.reshape(-1, len(root)), weight * errors.ravel())
    return Weights(prior.mean + root @ z, root @ covariance @ root.T, prior, noise, times, inflation)


def left_out(rows: Rows, prior: Prior) -> np.ndarray:
    """What each block of rows is predicted to be by the weights that the others give, (n, o)."""
    predicted = np.empty_like(rows.targets)
    for block in np.unique(rows.blocks):
        out = rows.blocks == block
        kept = rows[~out] if not out.all() else rows
        predicted[out] = identify(kept, prior).predict(rows.features[out])
    return predicted


def with_gains(prior: Prior, n_outputs: int, scale: float) -> Prior:
    """A prior with unknown gains behind the weights: c ~ N(0, scale²) each."""
    if scale == 0.0:
        return prior
    mean = np.concatenate([prior.mean, np.zeros(n_outputs)])
    covariance = np.zeros((len(mean), len(mean)))
    covariance[:-n_outputs, :-n_outputs] = prior.covariance
    covariance[-n_outputs:, -n_outputs:] = scale**2 * np.eye(n_outputs)
    return replace(prior, mean=mean, covariance=covariance)


def _forward(features: np.ndarray, mean: np.ndarray, prior: Prior) -> np.ndarray:
    p = len(prior.scaled)
    values = features @ mean[:p]
    if len(mean) == p:
        return values
    return values + mean[p:] * (features[:, :, prior.scaled] @ mean[:p][prior.scaled])


def _linearised(
    features: np.ndarray, targets: np.ndarray, mean: np.ndarray, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (n, o, P) in weights and gains, and the targets that a linear model of them has."""
    p = len(prior.scaled)
    if len(mean) == p:
        return features, targets
    c = mean[p:]
    n, n_outputs, _ = features.shape
    slopes = np.zeros((n, n_outputs, len(mean)))
    slopes[:, :, :p] = features
    slopes[:, :, :p][:, :, prior.scaled] *= (1.0 + c)[:, np.newaxis]
    scaled = features[:, :, prior.scaled] @ mean[:p][prior.scaled]
    slopes[:, range(n_outputs), range(p, len(mean))] = scaled
    return slopes, targets + c * scaled


def _noise_of(errors: np.ndarray, speed: np.ndarray, coulomb: float, last: JointNoise, least: float) -> JointNoise:
    found = likeliest_noise(errors, speed, coulomb, last.velocity, last)
    return found._replace(variance=max(found.variance, least))


def _variances(noise: list[JointNoise], speed: np.ndarray) -> np.ndarray:
    return np.column_stack([one.of(column) for one, column in zip(noise, speed.T, strict=True)])


def _solve(B: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of z ~ N(0, I) after errors = B z + N(0, I): by eigenvalues, which lose no direction."""
    eigenvalues, vectors = np.linalg.eigh(B.T @ B)
    shrunk = vectors / (1.0 + np.maximum(eigenvalues, 0.0))
    return shrunk @ (vectors.T @ (B.T @ errors)), shrunk @ vectors.T


def _inflation(B: np.ndarray, errors: np.ndarray, covariance: np.ndarray, blocks: np.ndarray) -> float:
    """Σ_b s_bᵀ Λ⁻¹ s_b over what it should be, Σ_b tr(Λ⁻¹ G_b - Λ⁻¹ G_b Λ⁻¹ G_b): weights were fitted to all blocks."""
    seen = expected = 0.0
    for block in np.unique(blocks):
        part = B[blocks == block].reshape(-1, B.shape[2])
        score = part.T @ errors[blocks == block].ravel()
        share = covariance @ (part.T @ part)
        seen += score @ covariance @ score
        expected += np.trace(share) - np.trace(share @ share)
    return float(max(1.0, seen / expected)) if expected > 0.0 else 1.0


def _root(covariance: np.ndarray) -> np.ndarray:
    """C with C Cᵀ = covariance, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return scale[:, np.newaxis] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0))

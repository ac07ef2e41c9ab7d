"""Bayesian regression of all outputs on weights that they share, with the outputs' gains and the noise of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from .rows_of_logs import correlation_time
from .stiction import JointNoise, likeliest_noise

# Noise, its correlation and gains settle in no more than so many rounds, when they move by less than this share.
_TRIAL_ROUNDS, _ROUNDS, _SETTLED = 4, 12, 0.02
# Where noise starts, in shares of an output's variance.
_FIRST_NOISE = (1.0, 1e-5)
# The smallest eigenvalue of a precision with unit diagonal that is no rounding error.
_SINGULAR = 1e-15
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
    runs, groups, blocks : ndarray of shape (n,)
        Labels of rows that follow each other without a gap, of those that may differ from others as a whole, and of
        those that are left out together.
    """

    features: np.ndarray
    targets: np.ndarray
    speed: np.ndarray
    runs: np.ndarray
    groups: np.ndarray
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
    velocity : ndarray of shape (o,)
        Up to which friction has no sign.
    """

    mean: np.ndarray
    covariance: np.ndarray
    scaled: np.ndarray
    coulomb: np.ndarray | None
    velocity: np.ndarray


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
        By which the groups differ more than that allows for, at least 1; the covariance knows of it.
    surprise : float
        How far the weights are from the prior mean, in prior standard deviations: a root mean square over what rows
        show of them; near 1 if the prior is right.
    """

    mean: np.ndarray
    covariance: np.ndarray
    prior: Prior
    noise: list[JointNoise]
    correlation_time: np.ndarray
    inflation: float
    surprise: float

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


def identify(rows: Rows, prior: Prior, *, start: Weights | None = None, known: Known | None = None) -> Weights:
    """The posterior of the weights: exact given noise, its correlation and gains, which are found with it.

    The noise of output j counts as many times as `correlation_time` says, so that filtered rows are counted as what
    they are worth. What groups of rows tell should then differ from each other as much as their information says: if
    the scores s_b = B_bᵀ e_b differ more, all of it is worth less by that ratio, ``inflation``.

    Parameters
    ----------
    rows : Rows
    prior : Prior
    start : Weights, optional
        Of nearly the same rows: where weights and noise start. Else they start twice, where the prior explains
        nothing and where it explains nearly all, and the more probable end is kept.
    known : Known, optional
        What other rows said before.

    Returns
    -------
    weights : Weights

    References
    ----------
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, Eq. 2.8: the posterior of a
      Bayesian linear model. Gains are linearised around their last value (Gauss-Newton).
    """
    problem = _Problem.of(rows, prior, known)
    if start is None:
        ends = [problem.settled(problem.first(share), _TRIAL_ROUNDS) for share in _FIRST_NOISE]
        state = max(ends, key=problem.log_probability)
    else:
        state = _State(start.mean, start.noise, start.correlation_time)
    state = problem.settled(state, _ROUNDS)
    B, errors = problem.whitened(state)
    z, covariance = _solve(B, errors)
    of_rows = B[: rows.targets.size].reshape(*rows.targets.shape, -1)
    left = (errors - B @ z)[: rows.targets.size].reshape(rows.targets.shape)
    inflation = _inflation(of_rows, left, covariance, rows.groups)
    if inflation > 1.0:
        weight = np.ones(len(B))
        weight[: rows.targets.size] = inflation**-0.5
        z, covariance = _solve(B * weight[:, np.newaxis], errors * weight)
    mean, root = prior.mean + problem.root @ z, problem.root
    surprise = float(np.sqrt(z @ z / max(1.0, len(z) - np.trace(covariance))))
    return Weights(mean, root @ covariance @ root.T, prior, state.noise, state.times, inflation, surprise)


def left_out(rows: Rows, weights: Weights) -> np.ndarray:
    """What each block of rows is predicted to be by the weights that the others give, (n, o)."""
    predicted = np.empty_like(rows.targets)
    for block in np.unique(rows.blocks):
        out = rows.blocks == block
        kept = rows[~out] if not out.all() else rows
        predicted[out] = identify(kept, weights.prior, start=weights).predict(rows.features[out])
    return predicted


class Known(NamedTuple):
    """A few rows that say what many have said: with unit noise, and the same squared errors for all weights.

    Attributes
    ----------
    features : ndarray of shape (p + 1, o, p)
    targets : ndarray of shape (p + 1, o)
    """

    features: np.ndarray
    targets: np.ndarray


def condensed(rows: Rows, weights: Weights) -> Known:
    """What rows said when weights were found: of each output the triangular factor of its whitened [H y]."""
    _, n_outputs, p = rows.features.shape
    scale = np.sqrt(weights.inflation * weights.correlation_time * _variances(weights.noise, rows.speed))
    features, targets = np.zeros((p + 1, n_outputs, p)), np.zeros((p + 1, n_outputs))
    for o in range(n_outputs):
        whole = np.column_stack([rows.features[:, o], rows.targets[:, o]]) / scale[:, o : o + 1]
        factor = np.asarray(np.linalg.qr(whole, mode="r"))
        features[: len(factor), o], targets[: len(factor), o] = factor[:, :p], factor[:, p]
    return Known(features, targets)


@dataclass(frozen=True)
class _State:
    """Where weights, noise and its correlation are while they settle."""

    mean: np.ndarray
    noise: list[JointNoise]
    times: np.ndarray


@dataclass(frozen=True)
class _Problem:
    """What `identify` settles: rows, their prior with its root C Cᵀ, the outputs' sizes, and what was known before."""

    rows: Rows
    prior: Prior
    known: Known | None
    root: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, rows: Rows, prior: Prior, known: Known | None) -> _Problem:
        y = rows.targets
        size = np.where(y.var(axis=0) > 0.0, y.var(axis=0), np.max(y**2, axis=0))
        return cls(rows, prior, known, _root(prior.covariance), np.where(size > 0.0, size, 1.0))

    def first(self, share: float) -> _State:
        """Noise of so much of each output's variance."""
        noise = [
            JointNoise(float(share * size), 0.0, float(velocity))
            for size, velocity in zip(self.size, self.prior.velocity, strict=True)
        ]
        return _State(self.prior.mean, noise, np.ones(len(noise)))

    def settled(self, state: _State, rounds: int) -> _State:
        """After so many rounds, or when noise hardly moves any more."""
        for _ in range(rounds):
            last, state = state, self._next(state)
            moved = [np.log(new.variance / old.variance) for new, old in zip(state.noise, last.noise, strict=True)]
            if np.abs(moved).max() < _SETTLED and np.abs(np.log(state.times / last.times)).max() < _SETTLED:
                break
        return state

    def _next(self, state: _State) -> _State:
        rows, prior = self.rows, self.prior
        mean = prior.mean + self.root @ _solve(*self.whitened(state))[0]
        left = rows.targets - _forward(rows.features, mean, prior)
        coulomb = np.zeros(len(self.size)) if prior.coulomb is None else np.abs(mean[prior.coulomb])
        noise = [
            likeliest_noise(left[:, o], rows.speed[:, o], float(coulomb[o]), last.velocity, least, last)
            for o, (last, least) in enumerate(zip(state.noise, _LEAST * self.size, strict=True))
        ]
        spread = np.sqrt(_variances(noise, rows.speed))
        times = np.array([correlation_time(errors, rows.runs) for errors in (left / spread).T])
        return _State(mean, noise, times)

    def whitened(self, state: _State) -> tuple[np.ndarray, np.ndarray]:
        """B and errors of the linear model errors = B z + N(0, I), z ~ N(0, I): rows, and then what was known."""
        scale = 1.0 / np.sqrt(_variances(state.noise, self.rows.speed) * state.times)
        parts = [(self.rows.features, self.rows.targets, scale)]
        if self.known is not None:
            parts.append((self.known.features, self.known.targets, np.ones_like(self.known.targets)))
        Bs, errors = [], []
        for features, targets, weight in parts:
            slopes, linear = _linearised(features, targets, state.mean, self.prior)
            Bs.append(((slopes * weight[:, :, np.newaxis]) @ self.root).reshape(-1, self.root.shape[1]))
            errors.append(((linear - slopes @ self.prior.mean) * weight).ravel())
        return np.concatenate(Bs), np.concatenate(errors)

    def log_probability(self, state: _State) -> float:
        """Of rows, as if they were independent, and weights, up to a constant."""
        variances = _variances(state.noise, self.rows.speed)
        left = self.rows.targets - _forward(self.rows.features, state.mean, self.prior)
        z = _solve(*self.whitened(state))[0]
        return -0.5 * float(np.sum(np.log(variances) + left**2 / variances) + z @ z)


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


def _variances(noise: list[JointNoise], speed: np.ndarray) -> np.ndarray:
    return np.column_stack([one.of(column) for one, column in zip(noise, speed.T, strict=True)])


def _solve(B: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of z ~ N(0, I) after errors = B z + N(0, I).

    The precision is scaled to a unit diagonal first: weights whose priors are wide in different degrees then lose no
    digits to each other.
    """
    precision = np.eye(B.shape[1]) + B.T @ B
    scale = np.sqrt(np.diag(precision))
    # SciPy's method: NumPy's, dividing and conquering, fails to converge on some finite matrices.
    eigenvalues, vectors = eigh(precision / np.outer(scale, scale))
    root = vectors / np.sqrt(np.maximum(eigenvalues, _SINGULAR)) / scale[:, np.newaxis]
    return root @ (root.T @ (B.T @ errors)), root @ root.T


def _inflation(B: np.ndarray, errors: np.ndarray, covariance: np.ndarray, groups: np.ndarray) -> float:
    """Σ_b s_bᵀ Λ⁻¹ s_b over what it should be, Σ_b tr(Λ⁻¹ G_b - Λ⁻¹ G_b Λ⁻¹ G_b): weights were fitted to all groups."""
    seen = expected = 0.0
    for group in np.unique(groups):
        part = B[groups == group].reshape(-1, B.shape[2])
        score = part.T @ errors[groups == group].ravel()
        share = covariance @ (part.T @ part)
        seen += score @ covariance @ score
        expected += np.trace(share) - np.trace(share @ share)
    return float(max(1.0, seen / expected)) if expected > 0.0 else 1.0


def _root(covariance: np.ndarray) -> np.ndarray:
    """C with C Cᵀ = covariance, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    eigenvalues, vectors = eigh(covariance / np.outer(unit, unit))
    return scale[:, np.newaxis] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0))

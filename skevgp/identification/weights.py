"""Bayesian regression of all outputs on shared weights, with the gain and the noise of each output."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import brentq

from ..fitting.prior import root_of_correlation
from .rows_of_logs import correlation_time
from .stiction import JointNoise, likeliest_noise

# Maximum numbers of rounds for noise, its correlation and gains. The rounds end at the last number, a relative change.
_TRIAL_ROUNDS, _ROUNDS, _SETTLED = 4, 12, 0.02
# Starting values of the noise, as shares of an output's variance.
_FIRST_NOISE = (1.0, 1e-5)
# Smaller eigenvalues of a precision with unit diagonal are rounding errors.
_SINGULAR = 1e-15
# Largest logarithm of a factor of a group's scale, up or down.
_WIDEST = np.log(1e4)
# Least noise, as a share of an output's variance.
_LEAST = 1e-12
# With standard deviations times this number, a prior has little effect.
_WEAK = 1e3


@dataclass(frozen=True)
class Rows:
    """Rows of the regression y = (1 + c) ∘ (H β)_scaled + (H β)_others + ε, with weights β and gains 1 + c."""

    features: np.ndarray  # H (n, o, p)
    targets: np.ndarray  # (n, o)
    speed: np.ndarray  # (n, o), for the noise of friction at rest (`JointNoise`)
    runs: np.ndarray  # (n,) labels of rows that follow each other without a gap
    groups: np.ndarray  # (n,) labels of sets of rows that may differ as a whole
    blocks: np.ndarray  # (n,) labels of rows that are held out together
    n_moves: int = 1  # number of trajectories that the user named

    def __getitem__(self, chosen: np.ndarray) -> Rows:
        arrays = {name: getattr(self, name)[chosen] for name in self.__dataclass_fields__ if name != "n_moves"}
        return replace(self, **arrays)


@dataclass(frozen=True)
class Prior:
    """Prior of the weights, followed by that of the gains if they are unknown."""

    mean: np.ndarray  # (P,), with P = p, or p + o with gains
    covariance: np.ndarray  # (P, P)
    scaled: np.ndarray  # (p,) whether gains multiply the weight. They do not multiply friction
    coulomb: np.ndarray | None  # (o,) index of Coulomb friction of each output, or None without static friction
    velocity: np.ndarray  # (o,) speed below which friction has no sign
    # (P,): labels of groups whose standard deviations are learned. They are independent of each other. Empty: it stays.
    groups: np.ndarray | None = None
    learned: bool = False  # whether standard deviations are learned already, and stay

    def scaled_by(self, factors: np.ndarray) -> Prior:
        """Return the prior with standard deviations times factors (P,), which then stay."""
        return replace(self, covariance=self.covariance * np.outer(factors, factors), learned=True)


@dataclass(frozen=True)
class Weights:
    """The posterior N(mean, covariance) of weights and gains."""

    mean: np.ndarray  # (P,)
    covariance: np.ndarray  # (P, P)
    prior: Prior
    noise: list[JointNoise]  # of each output
    correlation_time: np.ndarray  # (o,) number of rows with the information of an independent row
    inflation: float  # factor by which groups differ more than predicted, at least 1. The covariance includes it
    # Distance of the weights from the prior mean, in prior standard deviations. It is a root mean square over the
    # directions that rows determine, near 1 if the prior is right.
    surprise: float
    determined: float  # number of these directions
    # (P,): learned factors of the standard deviations of the prior as given. ``prior`` includes them.
    factors: np.ndarray

    @property
    def n_weights(self) -> int:
        return len(self.prior.scaled)

    def gains(self, n_outputs: int) -> np.ndarray:
        """Return 1 + c, (o,)."""
        c = self.mean[self.n_weights :]
        return 1.0 + (c if len(c) else np.zeros(n_outputs))

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Return the mean (n, o) for features (n, o, p)."""
        return _forward(features, self.mean, self.prior)

    def with_others(self, q: int) -> Weights:
        """Return a starting point for a prior with q more weights (`with_others`), which are 0."""
        at = [self.n_weights] * q
        return replace(self, mean=np.insert(self.mean, at, 0.0), factors=np.insert(self.factors, at, 1.0))

    def given(self, first: np.ndarray) -> Weights:
        """Return the posterior with given first weights, and with the conditional mean of the others."""
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
        """Return the variance of predictions due to weights and gains, (n, o), to first order in the gains."""
        slopes, _ = _linearised(features, np.zeros(features.shape[:2]), self.mean, self.prior)
        return np.maximum(np.einsum("nop,nop->no", slopes @ self.covariance, slopes), 0.0)


def identify(rows: Rows, prior: Prior, *, start: Weights | None = None, known: Known | None = None) -> Weights:
    """Find the posterior of the weights, with the most likely noise, its correlation and gains."""
    # The posterior is that of a Bayesian linear model (Rasmussen & Williams 2006, eq. 2.8). Gains are linearised around
    # their last value (Gauss-Newton). The noise variance is multiplied by a correlation time (`_Problem._times`), so
    # that filtered rows count less. Scores s_b = B_bᵀ e_b of groups should then differ as much as their information
    # predicts. If they differ more, all information is divided by that ratio, the inflation.
    #
    # The standard deviations of each group of weights are multiplied by a factor t with a log-normal prior, as in
    # `model.parameters.log_prior`. A step of expectation maximisation sets t to the maximum of
    # -n log t - ½ E[|z|²] t₀² / t² - ½ log² t, with n weights z of the group under the last factor t₀.
    #
    # If start is given, weights and noise start there. Otherwise there are two starts, one with all variance as noise
    # and one with little noise. The more probable result is kept.
    problem = _Problem.of(rows, prior, known)
    if start is None:
        ends = [problem.settled(problem.first(share), _TRIAL_ROUNDS) for share in _FIRST_NOISE]
        state = max(ends, key=problem.log_probability)
    else:
        state = _State(start.mean, start.noise, start.correlation_time, np.ones(len(prior.mean)))
    state = problem.settled(state, _ROUNDS)
    factors = state.factors
    problem, prior = replace(problem, root=factors[:, np.newaxis] * problem.root), prior.scaled_by(factors)
    state = replace(state, factors=np.ones(len(factors)))
    B, errors = problem.whitened(state)
    z, covariance = _solve(B.T @ B, B.T @ errors)
    of_rows = B[: rows.targets.size].reshape(*rows.targets.shape, -1)
    left = (errors - B @ z)[: rows.targets.size].reshape(rows.targets.shape)
    inflation = _inflation(of_rows, left, covariance, rows.groups)
    if inflation > 1.0:
        weight = np.ones(len(B))
        weight[: rows.targets.size] = inflation**-0.5
        B, errors = B * weight[:, np.newaxis], errors * weight
        z, covariance = _solve(B.T @ B, B.T @ errors)
    mean, root = prior.mean + problem.root @ z, problem.root
    # The surprise is in standard deviations of the given prior, without factors.
    if start is not None:
        factors = factors * start.factors
    determined = float(len(z) - np.trace(covariance))
    surprise = float(np.sqrt(np.sum((factors * z) ** 2) / max(1.0, determined)))
    covariance = root @ covariance @ root.T
    return Weights(mean, covariance, prior, state.noise, state.times, inflation, surprise, determined, factors)


class Fold(NamedTuple):
    """Held-out rows, and the torques that the weights from the other rows predict."""

    out: np.ndarray  # (n,) whether a row was held out
    torques: np.ndarray  # (n, o) of all rows
    variance: np.ndarray  # (n_out, o) of the torques of the held-out rows, due to the weights


def folds(rows: Rows, weights: Weights) -> list[Fold]:
    """Identify the weights again without each block of rows."""
    found = []
    for block in np.unique(rows.blocks):
        out = rows.blocks == block
        kept = rows[~out] if not out.all() else rows
        own = identify(kept, weights.prior, start=weights)
        found.append(Fold(out, own.predict(rows.features), own.variance(rows.features[out])))
    return found


class Known(NamedTuple):
    """A few rows that replace many: with unit noise, they have the same squared errors for all weights."""

    features: np.ndarray  # (p + 1, o, p)
    targets: np.ndarray  # (p + 1, o)


def condensed(rows: Rows, weights: Weights, effects: np.ndarray | None = None) -> Known:
    """Condense rows to the triangular factor of the whitened [H y] of each output."""
    # effects E (n, o, k) are columns with weights N(0, I), which are independent for each output and each move
    # (``groups``). They are integrated out. In the QR factorisation of [E H y; I 0 0], the rows below the first k are
    # the factor of the marginal likelihood.
    _, n_outputs, p = rows.features.shape
    scale = np.sqrt(weights.inflation * weights.correlation_time * _variances(weights.noise, rows.speed))
    features, targets = np.zeros((p + 1, n_outputs, p)), np.zeros((p + 1, n_outputs))
    moves = [rows.groups == move for move in np.unique(rows.groups)]
    for o in range(n_outputs):
        whole = np.column_stack([rows.features[:, o], rows.targets[:, o]]) / scale[:, o : o + 1]
        if effects is not None:
            own = effects[:, o] / scale[:, o : o + 1]
            whole = np.concatenate([_without(own[move], whole[move]) for move in moves])
        factor = np.asarray(np.linalg.qr(whole, mode="r"))
        features[: len(factor), o], targets[: len(factor), o] = factor[:, :p], factor[:, p]
    return Known(features, targets)


def _without(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Integrate out columns (n, k) with weights N(0, I): return fewer rows with the likelihood of rows (n, m)."""
    k = columns.shape[1]
    whole = np.block([[columns, rows], [np.eye(k), np.zeros((k, rows.shape[1]))]])
    return np.asarray(np.linalg.qr(whole, mode="r"))[k:, k:]


@dataclass(frozen=True)
class _State:
    """Weights, noise and its correlation after a round of `identify`."""

    mean: np.ndarray
    noise: list[JointNoise]
    times: np.ndarray
    factors: np.ndarray  # (P,) of the prior's standard deviations


@dataclass(frozen=True)
class _Problem:
    """The problem of `identify`: rows, the prior with covariance C Cᵀ and root C, sizes of outputs, and known rows."""

    rows: Rows
    prior: Prior
    known: Known | None
    root: np.ndarray
    size: np.ndarray
    shared: bool  # whether a weight affects several outputs

    @classmethod
    def of(cls, rows: Rows, prior: Prior, known: Known | None) -> _Problem:
        y = rows.targets
        size = np.where(y.var(axis=0) > 0.0, y.var(axis=0), np.max(y**2, axis=0))
        shared = bool((np.count_nonzero(np.abs(rows.features).max(axis=0), axis=0) > 1).any())
        return cls(rows, prior, known, _root(prior.covariance, prior.groups), np.where(size > 0.0, size, 1.0), shared)

    def first(self, share: float) -> _State:
        """Return the starting state, with this share of each output's variance as noise."""
        noise = [
            JointNoise(float(share * size), 0.0, float(velocity))
            for size, velocity in zip(self.size, self.prior.velocity, strict=True)
        ]
        return _State(self.prior.mean, noise, np.ones(len(noise)), np.ones(len(self.prior.mean)))

    def settled(self, state: _State, rounds: int) -> _State:
        """Return the state after this number of rounds, or after a round with little change."""
        for _ in range(rounds):
            last, state = state, self._next(state)
            moved = [np.log(new.variance / old.variance) for new, old in zip(state.noise, last.noise, strict=True)]
            moved += [*np.log(state.times / last.times), *np.log(state.factors / last.factors)]
            if np.abs(moved).max() < _SETTLED:
                break
        return state

    def _next(self, state: _State) -> _State:
        # Expectation maximisation: squared errors have the expectation of their posterior. If weights fit the noise of
        # a joint, its errors are small, and their posterior variance is large.
        rows, prior = self.rows, self.prior
        B, errors = self.whitened(state)
        information, score = B.T @ B, B.T @ errors
        z, covariance = _solve(information, score)
        mean = prior.mean + state.factors * (self.root @ z)
        of_rows = B[: rows.targets.size]
        uncertain = np.maximum(np.einsum("np,np->n", of_rows @ covariance, of_rows), 0.0).reshape(rows.targets.shape)
        uncertain *= state.times * _variances(state.noise, rows.speed)
        left = np.sqrt((rows.targets - _forward(rows.features, mean, prior)) ** 2 + uncertain)
        coulomb = np.zeros(len(self.size)) if prior.coulomb is None else np.abs(mean[prior.coulomb])
        noise = [
            likeliest_noise(left[:, o], rows.speed[:, o], float(coulomb[o]), last.velocity, least, last)
            for o, (last, least) in enumerate(zip(state.noise, _LEAST * self.size, strict=True))
        ]
        free = errors - B @ _solve(information, score, 1.0 / _WEAK**2)[0]
        times = self._times(free[: rows.targets.size].reshape(rows.targets.shape))
        return _State(mean, noise, times, self._next_factors(state, z**2 + np.diag(covariance)))

    def _times(self, errors: np.ndarray) -> np.ndarray:
        """Return correlation times (o,), given errors (n, o) of a regression with a weak prior."""
        # With the errors of the regression itself, there would be no way back: if the rows of a joint count little, its
        # errors are large and slow, and then its rows count even less. For the same reason, joints with shared weights
        # have the mean of their times.
        times = np.array([correlation_time(column, self.rows.runs) for column in errors.T])
        return np.full(len(times), times.mean()) if self.shared else times

    def _next_factors(self, state: _State, squares: np.ndarray) -> np.ndarray:
        """Return the factors (P,) after a step of expectation maximisation, given E[z²] (P,)."""
        factors = state.factors.copy()
        if self.prior.groups is None or self.prior.learned:
            return factors
        p = len(self.prior.scaled)
        for group in dict.fromkeys(self.prior.groups):
            if group:
                own = self.prior.groups == group
                n, total = own.sum(), squares[own].sum() * factors[own][0] ** 2
                # Rows determine some combinations of inertial parameters only. Small errors of these must not narrow
                # the prior of the others. With unknown gains, the scale of all masses is one of the others.
                least = 0.0 if self.prior.scaled[own[:p]].any() else -_WIDEST
                # -n + total / t² - log t falls with log t. It is 0 at the best t, or beyond the limits of t.
                low, high = (total * np.exp(-2.0 * edge) - n - edge for edge in (least, _WIDEST))
                best = least if low <= 0.0 else _WIDEST
                if low > 0.0 > high:
                    best = brentq(lambda log: total * np.exp(-2.0 * log) - n - log, least, _WIDEST)  # noqa: B023
                factors[own] = np.exp(best)
        return factors

    def whitened(self, state: _State) -> tuple[np.ndarray, np.ndarray]:
        """Return B and errors of the linear model errors = B z + N(0, I), z ~ N(0, I), for rows and then known rows."""
        scale = 1.0 / np.sqrt(_variances(state.noise, self.rows.speed) * state.times)
        parts = [(self.rows.features, self.rows.targets, scale)]
        if self.known is not None:
            parts.append((self.known.features, self.known.targets, np.ones_like(self.known.targets)))
        Bs, errors = [], []
        for features, targets, weight in parts:
            slopes, linear = _linearised(features, targets, state.mean, self.prior)
            root = state.factors[:, np.newaxis] * self.root
            # One product of matrices is faster than one for each row.
            Bs.append((slopes * weight[:, :, np.newaxis]).reshape(-1, len(root)) @ root)
            errors.append(((linear - slopes @ self.prior.mean) * weight).ravel())
        return np.concatenate(Bs), np.concatenate(errors)

    def log_probability(self, state: _State) -> float:
        """Return the log probability of rows, as if independent, and of factors, up to a constant."""
        variances = _variances(state.noise, self.rows.speed)
        left = self.rows.targets - _forward(self.rows.features, state.mean, self.prior)
        # Laplace's approximation adds ½ log|Σ|, with the posterior covariance Σ of z.
        B, errors = self.whitened(state)
        z, covariance = _solve(B.T @ B, B.T @ errors)
        of_rows = np.sum(np.log(variances) + left**2 / variances)
        groups = [] if self.prior.groups is None else [group for group in dict.fromkeys(self.prior.groups) if group]
        logs = np.log([state.factors[self.prior.groups == group][0] for group in groups])
        return -0.5 * float(of_rows + z @ z - np.linalg.slogdet(covariance)[1] + logs @ logs)


def with_gains(prior: Prior, n_outputs: int, scale: float) -> Prior:
    """Add an unknown gain of each output, with c ~ N(0, scale²), after the weights."""
    if scale == 0.0:
        return prior
    mean = np.concatenate([prior.mean, np.zeros(n_outputs)])
    covariance = np.zeros((len(mean), len(mean)))
    covariance[:-n_outputs, :-n_outputs] = prior.covariance
    covariance[-n_outputs:, -n_outputs:] = scale**2 * np.eye(n_outputs)
    groups = None if prior.groups is None else np.concatenate([prior.groups, [""] * n_outputs])
    return replace(prior, mean=mean, covariance=covariance, groups=groups)


def with_others(prior: Prior, variances: np.ndarray, *, scaled: bool = False) -> Prior:
    """Add independent weights with mean 0 between the weights and the gains."""
    p, q = len(prior.scaled), len(variances)
    kept = np.concatenate([np.arange(p), np.arange(p + q, len(prior.mean) + q)])
    covariance = np.zeros((len(prior.mean) + q, len(prior.mean) + q))
    covariance[np.ix_(kept, kept)] = prior.covariance
    covariance[range(p, p + q), range(p, p + q)] = variances
    return replace(
        prior,
        mean=np.insert(prior.mean, [p] * q, 0.0),
        covariance=covariance,
        scaled=np.append(prior.scaled, np.full(q, scaled)),
        groups=None if prior.groups is None else np.insert(prior.groups, [p] * q, ""),
    )


def _forward(features: np.ndarray, mean: np.ndarray, prior: Prior) -> np.ndarray:
    p = len(prior.scaled)
    values = features @ mean[:p]
    if len(mean) == p:
        return values
    return values + mean[p:] * (features[:, :, prior.scaled] @ mean[:p][prior.scaled])


def _linearised(
    features: np.ndarray, targets: np.ndarray, mean: np.ndarray, prior: Prior
) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes (n, o, P) in weights and gains, and the targets (n, o) of the linear model with them."""
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


def _solve(information: np.ndarray, score: np.ndarray, precision: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of z ~ N(0, I / precision), given BᵀB and Bᵀe of the model e = B z + N(0, I)."""
    # The posterior precision is scaled to a unit diagonal, so that priors of different widths do not lose accuracy.
    whole = precision * np.eye(len(information)) + information
    scale = np.sqrt(np.diag(whole))
    # This is SciPy's eigh, because NumPy's divide and conquer does not converge for some finite matrices.
    eigenvalues, vectors = eigh(whole / np.outer(scale, scale))
    root = vectors / np.sqrt(np.maximum(eigenvalues, _SINGULAR)) / scale[:, np.newaxis]
    return root @ (root.T @ score), root @ root.T


def _inflation(B: np.ndarray, errors: np.ndarray, covariance: np.ndarray, groups: np.ndarray) -> float:
    """Return Σ_b s_bᵀ Λ⁻¹ s_b divided by its expectation Σ_b tr(Λ⁻¹ G_b - Λ⁻¹ G_b Λ⁻¹ G_b), but at least 1."""
    seen = expected = 0.0
    for group in np.unique(groups):
        part = B[groups == group].reshape(-1, B.shape[2])
        score = part.T @ errors[groups == group].ravel()
        share = covariance @ (part.T @ part)
        seen += score @ covariance @ score
        expected += np.trace(share) - np.trace(share @ share)
    return float(max(1.0, seen / expected)) if expected > 0.0 else 1.0


def _root(covariance: np.ndarray, groups: np.ndarray | None) -> np.ndarray:
    """Return C with C Cᵀ = covariance and no entries between groups. The covariance may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    labels = np.zeros(len(scale)) if groups is None else groups
    return scale[:, np.newaxis] * root_of_correlation(covariance / np.outer(unit, unit), labels)

"""The residual torque of one joint: a Gaussian process of the joint's own signals, effects of moves, and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import softmax
from sklearn.base import clone
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from ..estimators.evgp import EVGPRegressor
from ..kernels.parse import KernelSpec
from .moves import FEWEST_MOVES, MoveEffects, terms, variation
from .rows_of_logs import correlation_time, evenly_spread
from .stiction import JointNoise, likeliest_noise, noise_at
from .weights import Fold, Rows

# A kernel is fitted only if the mean square of the residual torque is larger.
_NOTHING = 1e-90
# Limits of the kernel, in standard deviations of residuals and of columns. A signal that is larger than the residuals,
# or that changes within a fraction of the range of positions, fits single moves only. Friction does change within a
# fraction of the range of speeds. With longer length scales than the last limit, f does not return to 0 outside the
# training moves.
_LARGEST_SIGNAL, _SMALLEST_SIGNAL = 1.0, 1e-3
_SHORTEST, _SHORTEST_OF_SPEED, _START, _LONGEST = 1.0, 0.01, 1.5, 3.0
# Least noise with f, as a share of the noise without f.
_LEAST = 1e-6
# Least share of the variance of held-out errors that is noise and not the uncertainty of f.
_OWN = 0.05
# Part of the variance of the weights in held-out errors that counts as noise.
_AS_NOISE = 0.5
# Limits of rows and iterations of a fit that leaves a move out.
_ROWS_OF_TRIAL, _ITERATIONS_OF_TRIAL = 500, 20
# Candidates of the share of f. Smaller shares are 0. If no share changes the mean square error of a held-out move by
# more than the last number, relative to it, f is 0.
_SHARES, _SMALLEST_SHARE, _NO_CHANGE = np.linspace(0.0, 1.0, 11), 0.02, 1e-3
# Mean square errors of a move are at least this part of the mean over moves.
_LEAST_SQUARE = 1e-6
# A held-out move counts as at most this number of independent rows.
_MOST_OF_MOVE = 10.0
# Moves differ more than their scatter shows, because few are held out. So its variance is multiplied by the first
# number. The second number is the part of the share that is kept, whatever the scatter.
_SCATTER, _KEPT = 2.0, 0.25


class QuietRegressor(EVGPRegressor):
    """A regressor that does not warn about kernel parameters at their bounds, because these are not the user's."""

    def _warn(self, messages: tuple[str, ...], spec: KernelSpec) -> None:
        """Do not warn."""

    def faded(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the faded mean of f and its variance, (n,) each."""
        # The mean is multiplied by 1 - v / s², where s² and v are the variances of f before and after the data. This
        # factor is near 1 at training rows and 0 far from them.
        kernel: Any = self.kernel_
        mean, std = self.predict(x, return_std=True, include_noise=False)
        return np.maximum(1.0 - std**2 / kernel.k1.constant_value, 0.0) * mean, std**2


@dataclass(frozen=True)
class JointResidual:
    """A joint's residual torque a f(x_j), with a Gaussian process f and a share a, its effects of moves, and noise."""

    model: QuietRegressor | None  # of the joint's own columns; None if physics alone predicts
    noise: JointNoise
    share: float
    effects: MoveEffects  # of a move without training rows
    update: MoveEffects | None  # as in `Variation`
    move: MoveEffects  # of the move to predict
    # (moves,): logarithms of the mean squares of errors in held-out moves, in predicted standard deviations.
    log_squares: np.ndarray

    @property
    def signal(self) -> float:
        """Return the prior standard deviation of a f."""
        if self.model is None:
            return 0.0
        kernel: Any = self.model.kernel_
        return self.share * float(np.sqrt(kernel.k1.constant_value))

    def mean(self, x: np.ndarray) -> np.ndarray:
        return self.moments(x)[0]

    def moments(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the variance of a f, (n,) each."""
        if self.model is None:
            return np.zeros(len(x)), np.zeros(len(x))
        mean, variance = self.model.faded(x)
        return self.share * mean, self.share**2 * variance


def fit_joint_residual(
    x: np.ndarray,
    residual: np.ndarray,
    folds: list[Fold],
    target: np.ndarray,
    rows: Rows,
    speed: np.ndarray,
    noise: JointNoise,
    velocity: float,
    some: np.ndarray,
    smooth: np.ndarray,
    usual: np.ndarray,
    **options: Any,
) -> JointResidual:
    """Fit the Gaussian process of a joint to some of the rows x (n, d). Held-out moves give its share."""
    # residual (n,) is the target (n,) minus the torque by the weights of all rows. Each fold has the torques by the
    # weights of the other moves. noise is that of the residual without f. velocity is v_s: at lower speeds, rows count
    # less for f, because the sign of friction is unknown. If filters blur the sign, the noise is larger up to a higher
    # speed than v_s, but there f learns the average friction. some are the indices of the rows that f is fitted to.
    # smooth (d,) marks the columns of x with long length scales. usual (4,) has the standard deviations of effects of
    # moves in general. options are those of EVGPRegressor.
    physics, missed, known = np.empty(len(x)), np.empty(len(x)), np.empty(len(x))
    for fold in folds:
        physics[fold.out], known[fold.out] = fold.torques[fold.out], fold.variance
        missed[fold.out] = (target - fold.torques)[fold.out]

    def with_moves(model: QuietRegressor | None, share: float, missed: np.ndarray, own: np.ndarray) -> JointResidual:
        # The variance of errors is the sum of own (n,), the variance of f, of known (n,), that of the weights, of the
        # variance of effects of moves, and of noise. A part of the variance of the weights counts as noise, because
        # errors of new moves are larger than those of held-out ones.
        own, as_noise = own + (1.0 - _AS_NOISE) * known, _AS_NOISE * known
        found = likeliest_noise(missed, speed, noise.coulomb, noise.velocity, least)
        left = found.variance - float(np.mean(own * found.variance / found.of(speed)))
        floor = _OWN * found.variance if model is not None else noise.variance
        found = found._replace(variance=max(left, floor))
        z = terms(speed, physics, found.velocity)
        effects, update, found = variation(z, missed, speed, found, own, rows, usual)
        squares = missed**2 / (found.of(speed) + effects.moments(z)[1] + own + as_noise)
        logs = [np.log(max(float(np.mean(squares[rows.groups == move])), 1e-300)) for move in np.unique(rows.groups)]
        return JointResidual(model, found, share, effects, update, effects, np.array(logs))

    size, least = float(np.mean(residual**2)), _LEAST * noise.variance
    if size <= _NOTHING:
        nothing = MoveEffects.none()
        found = likeliest_noise(missed, speed, noise.coulomb, noise.velocity, noise.variance)
        return JointResidual(None, found, 0.0, nothing, None, nothing, np.zeros(0))
    if not options["n_inducing"]:
        return with_moves(None, 0.0, missed, np.zeros(len(x)))
    spread = x[some].std(axis=0)
    spread = np.where(spread > 1e-9 * np.abs(x[some]).max(axis=0), spread, 1.0)
    shortest = np.where(smooth, _SHORTEST, _SHORTEST_OF_SPEED)
    signal = ConstantKernel(0.25 * size, (_SMALLEST_SIGNAL**2 * size, _LARGEST_SIGNAL**2 * size))
    kernel = signal * RBF(_START * spread, np.column_stack([shortest * spread, _LONGEST * spread]))
    sharp = noise_at(residual, speed, noise.coulomb, velocity, least)
    relative = sharp.of(speed) / sharp.variance
    model = QuietRegressor(kernel=kernel, noise_cv=None, **options)
    # Each move is predicted by a fit to the others. Each fit starts from the same values, because the parameters of the
    # previous fit have used the move.
    mean, variance = np.empty(len(x)), np.empty(len(x))
    iterations = model.max_iter if model.max_iter is not None else _ITERATIONS_OF_TRIAL
    trial = clone(model).set_params(max_iter=min(iterations, _ITERATIONS_OF_TRIAL))
    for fold in folds:
        kept = np.flatnonzero(~fold.out if not fold.out.all() else fold.out)
        kept = kept[evenly_spread(len(kept), _ROWS_OF_TRIAL)]
        trial.fit(x[kept], (target - fold.torques)[kept], relative_variance=relative[kept])
        mean[fold.out], variance[fold.out] = trial.faded(x[fold.out])
    share = _share(missed, mean, relative, rows.groups if rows.n_moves >= FEWEST_MOVES else rows.blocks)
    if share == 0.0:
        return with_moves(None, 0.0, missed, np.zeros(len(x)))
    model.fit(x[some], residual[some], relative_variance=relative[some])
    return with_moves(model, share, missed - share * mean, share**2 * variance)


def _share(missed: np.ndarray, mean: np.ndarray, relative: np.ndarray, moves: np.ndarray) -> float:
    """Return the share of f that is expected to give the smallest error on new moves."""
    # Given the errors of a move with n independent rows and unknown noise, the log density of a share a is
    # -n/2 log(mean square). Its sum over moves gives the posterior mean of a, with a uniform prior.
    #
    # A new move may differ from all held-out ones. If the mean fall of log(mean square) over moves is m, with the
    # standard error s, the part of m that is not scatter is about 1 - s² / m² (James & Stein 1961), or 0. Here s²
    # counts _SCATTER times. A part of the posterior mean is kept, and the rest is multiplied by the part of m.
    groups = [moves == move for move in np.unique(moves)]
    if len(groups) < 2:
        return 0.0
    squares = np.array([[np.mean((missed - a * mean)[own] ** 2 / relative[own]) for own in groups] for a in _SHARES])
    least = max(_LEAST_SQUARE * float(squares[0].mean()), 1e-300)
    falls = np.log(np.maximum(squares, least)) - np.log(np.maximum(squares[0], least))  # (shares, moves)
    if np.abs(falls).max() < _NO_CHANGE:
        return 0.0
    time = correlation_time((missed - 0.5 * mean) / np.sqrt(relative), moves)
    worth = np.minimum([own.sum() / time for own in groups], _MOST_OF_MOVE)
    share = float(softmax(-0.5 * falls @ worth) @ _SHARES)
    fall = np.array([np.interp(share, _SHARES, of_move) for of_move in falls.T])
    mean_fall, error = float(fall.mean()), float(fall.std(ddof=1)) / np.sqrt(len(fall))
    steady = max(0.0, 1.0 - _SCATTER * (error / mean_fall) ** 2) if mean_fall < 0.0 else 0.0
    share *= _KEPT + (1.0 - _KEPT) * steady
    return share if share > _SMALLEST_SHARE else 0.0

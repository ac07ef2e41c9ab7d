"""Train a variational network: standardised data, mini-batches, rows held back to know when to stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..solvers.adam import adam, is_flat
from ..solvers.base import Minimum
from ..utils.monitor import Monitor
from ..utils.validation import LARGEST
from .bnn_model import Layer, VariationalNetwork

# A column whose entries differ by so many rounding errors is constant.
_ROUNDING = 8.0 * np.finfo(float).eps


@dataclass(frozen=True)
class Scaling:
    """Between the user's units and standardised ones.

    Attributes
    ----------
    x_mean, x_scale : ndarray of shape (d,)
    y_mean, y_scale : ndarray of shape (o,)
    """

    x_mean: np.ndarray
    x_scale: np.ndarray
    y_mean: np.ndarray
    y_scale: np.ndarray

    @classmethod
    def of(cls, X: np.ndarray, Y: np.ndarray, counts: np.ndarray | None = None) -> Scaling:
        """The scaling of a training set, whose rows count so often, or once."""
        return cls(*_mean_and_scale(X, counts), *_mean_and_scale(Y, counts))

    @property
    def log_unit(self) -> float:
        """What a row adds to the loss on the way to the user's units."""
        return float(np.log(self.y_scale).sum())

    def inputs(self, X: np.ndarray) -> np.ndarray:
        """Standardised inputs; so far out that their squares would overflow, they get no farther."""
        return np.clip((X - self.x_mean) / self.x_scale, -LARGEST, LARGEST)

    def targets(self, Y: np.ndarray) -> np.ndarray:
        """Standardised targets."""
        return (Y - self.y_mean) / self.y_scale

    def to_users(self, layers: list[Layer], log_noise: np.ndarray) -> tuple[list[Layer], np.ndarray]:
        """The same network as a function of ``X - x_mean``, in units of X and y."""
        layers = [Layer(layer.mean.copy(), layer.log_std.copy(), layer.bias.copy()) for layer in layers]
        first, last, columns = layers[0], layers[-1], self.x_scale[:, np.newaxis]
        first.mean[:] /= columns
        first.log_std[:] -= np.log(columns)
        last.mean[:] *= self.y_scale
        last.log_std[:] += np.log(self.y_scale)
        last.bias[:] = last.bias * self.y_scale + self.y_mean
        return layers, log_noise + 2.0 * np.log(self.y_scale)

    def take_over(
        self, before: Scaling, old: tuple[list[Layer], np.ndarray], new: tuple[list[Layer], np.ndarray]
    ) -> None:
        """Make ``new`` in this scaling the network that ``old`` was in another."""
        layers, log_noise = before.to_users(*old)
        first, last, columns = layers[0], layers[-1], self.x_scale[:, np.newaxis]
        first.bias[:] += (self.x_mean - before.x_mean) @ first.mean
        first.mean[:] *= columns
        first.log_std[:] += np.log(columns)
        last.mean[:] /= self.y_scale
        last.log_std[:] -= np.log(self.y_scale)
        last.bias[:] = (last.bias - self.y_mean) / self.y_scale
        for target, source in zip(new[0], layers, strict=True):
            target.mean[:], target.log_std[:], target.bias[:] = source.mean, source.log_std, source.bias
        new[1][:] = log_noise - 2.0 * np.log(self.y_scale)


def _mean_and_scale(values: np.ndarray, counts: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Of columns; what is constant becomes 0, in units of itself."""
    largest = np.abs(values).max(axis=0)
    constant = np.ptp(values, axis=0) <= _ROUNDING * largest
    if counts is None:
        mean = np.where(constant, values[0], values.mean(axis=0))
        deviation = (values - mean).std(axis=0)
    else:
        mean = np.where(constant, values[0], counts @ values / counts.sum())
        deviation = np.sqrt(counts @ (values - mean) ** 2 / counts.sum())
    scale = np.where(constant, largest, deviation)
    return mean, np.where(scale > 0.0, scale, 1.0)


@dataclass(frozen=True)
class Training:
    """How the training went.

    Attributes
    ----------
    theta : ndarray of shape (n_parameters,)
        The parameters to keep.
    minimum : Minimum
        What Adam found.
    losses : ndarray of shape (n_epochs,)
        Mean over each epoch's mini-batches.
    scores : ndarray of shape (n_epochs,)
        Expected log likelihood per row held back; empty if there are none.
    still_falling : bool
        Whether all steps were used and the loss had not settled.
    """

    theta: np.ndarray
    minimum: Minimum
    losses: np.ndarray
    scores: np.ndarray
    still_falling: bool

    def how_it_ended(self, max_iter: int, tol: float, interrupted: bool) -> str:
        """What the user should know of how it ended; empty if all is well."""
        if interrupted:
            return f"The fit was interrupted in epoch {len(self.losses)}; the best parameters so far are kept."
        if not self.minimum.converged:
            return "The loss did not stay finite; the best parameters so far are kept. Lower learning_rate_init."
        if self.still_falling:
            return (
                f"The loss still fell when max_iter={max_iter} epochs were used up. Raise max_iter, or stop earlier on "
                f"purpose with a larger tol (now {tol})."
            )
        return ""


def train(
    network: VariationalNetwork,
    start: np.ndarray,
    X: np.ndarray,
    Y: np.ndarray,
    rng: np.random.Generator,
    *,
    n_held_back: int,
    max_iter: int,
    batch_size: int,
    learning_rate: float,
    tol: float,
    patience: int,
    monitor: Monitor | None = None,
    counts: np.ndarray | None = None,
) -> Training:
    """Adam on mini-batches of freshly shuffled rows.

    Parameters
    ----------
    network : VariationalNetwork
    start : ndarray of shape (n_parameters,)
    X, Y : ndarray of shape (n, d), (n, o)
        Standardised.
    rng : Generator
    n_held_back : int
        Rows, chosen at random, not to learn from: the parameters that explain them best after an epoch are kept.
    max_iter : int
        Epochs at most.
    batch_size : int
    learning_rate, tol, monitor
        As in `adam`.
    patience : int
        Epochs without a gain of ``tol`` on the rows held back after which training ends.
    counts : ndarray of shape (n,), optional
        How often each row counts; None are ones. Rows are drawn alike, however often they count.
    """
    held_back = np.zeros(len(X), dtype=np.bool_)
    held_back[rng.permutation(len(X))[:n_held_back]] = True
    others = X[held_back], Y[held_back]
    X, Y = X[~held_back], Y[~held_back]
    weights, others_weights = _in_units_of_mean(counts, ~held_back), _in_units_of_mean(counts, held_back)
    n_rows = float(len(X) if counts is None else counts[~held_back].sum())
    steps = -(-len(X) // batch_size)
    order = np.empty(0, dtype=int)

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal order
        if len(order) == 0:
            order = rng.permutation(len(X))
        batch, order = order[:batch_size], order[batch_size:]
        draws = rng.standard_normal((len(batch), network.n_hidden))
        own = None if weights is None else weights[batch]
        return network.loss_and_gradient(theta, X[batch], Y[batch], draws, n_rows, own)

    watch = None
    if n_held_back > 0:
        # The same draws at each epoch: scores differ because parameters do.
        draws = rng.standard_normal((n_held_back, network.n_hidden))
        watch = _EarlyStopping(
            lambda theta: network.expected_log_likelihood(theta, *others, draws, others_weights), steps, tol, patience
        )
    minimum = adam(objective, start, network.limits(), max_iter * steps, learning_rate, tol, monitor, stop=watch)
    losses = np.array(minimum.loss_curve)
    return Training(
        minimum.x if watch is None or watch.theta is None else watch.theta,
        minimum,
        np.array([losses[first : first + steps].mean() for first in range(0, len(losses), steps)]),
        np.array([] if watch is None else watch.scores),
        minimum.n_iter == max_iter * steps and not is_flat(losses, tol),
    )


def _in_units_of_mean(counts: np.ndarray | None, rows: np.ndarray) -> np.ndarray | None:
    """The counts of some rows, if there are any, with a mean of 1."""
    return None if counts is None or not rows.any() else counts[rows] / counts[rows].mean()


class _EarlyStopping:
    """Score the parameters after each epoch, remember the best, and say when there were none better for long."""

    def __init__(self, score: Callable[[np.ndarray], float], steps_per_epoch: int, tol: float, patience: int):
        self._score, self._steps, self._tol, self._patience = score, steps_per_epoch, tol, patience
        self._n_steps, self._since_gain, self._best, self._bar = 0, 0, -np.inf, -np.inf
        self.theta: np.ndarray | None = None
        self.scores: list[float] = []

    def __call__(self, theta: np.ndarray) -> bool:
        self._n_steps += 1
        if self._n_steps % self._steps:
            return False
        score = self._score(theta)
        self.scores.append(score)
        if score > self._best:
            self._best, self.theta = score, theta
        if score > self._bar + self._tol:
            self._bar, self._since_gain = score, 0
        else:
            self._since_gain += 1
        return self._since_gain >= self._patience

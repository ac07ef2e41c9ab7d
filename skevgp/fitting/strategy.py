"""From which starts a model is fitted, one after the other, and which of the fits is kept.

A fit may end where the noise explains everything, or with inducing points where nothing happens: one start is not
enough. `Strategy.attempts` names the next start given how those before ended, and `search` does what it says:
``for attempt in attempts: best = better(best, minimise(attempt))``. ARCHITECTURE.md has a table of the rules, what each
prevents, and the test that fails without it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from ..model.parameters import ParameterTable, Values
from ..model.predictor import Predictor
from ..utils.monitor import Monitor
from .rules import Rules

# Nats: by less than this, a white kernel and noise are below each other by rounding.
_WORTH = 0.01
# Of a mean row's noise: so little signal costs next to nothing, and is still told by the gradient whether to grow.
_LITTLE = 1e-4


@dataclass(frozen=True)
class Fit:
    """Where an optimiser ended.

    Attributes
    ----------
    values : dict
        Of the model's parameters, in internal units.
    bound : float
        In nats, in internal units; -inf if it could not be computed.
    loss_curve : list of float
        Minus the bound per iteration, those of the fits it went on from first.
    converged : bool
    message : str
        What the user should know of how it ended; empty if it converged.
    predictor : Predictor, optional
        If q is not at its optimum for the values.
    n_rows : int, optional
        Of the sample that it is a fit to; None means all rows.
    widened : tuple of str
        Parameters that had their widest limits.
    """

    values: Values
    bound: float
    loss_curve: list[float] = field(default_factory=list)
    converged: bool = True
    message: str = ""
    predictor: Predictor | None = None
    n_rows: int | None = None
    widened: tuple[str, ...] = ()

    @property
    def n_iter(self) -> int:
        return len(self.loss_curve)

    @property
    def rank(self) -> tuple[float, float]:
        """By which the better of two fits is known: one to more rows is."""
        return np.inf if self.n_rows is None else self.n_rows, self.bound


@dataclass(frozen=True)
class Attempt:
    """A start.

    Attributes
    ----------
    values : dict
        First values of the parameters that are free.
    until : int
        The most iterations, those of ``after`` among them.
    after : Fit, optional
        The fit to the same rows that it goes on from.
    n_rows : int, optional
        Of the sample that is fitted; None means all rows.
    cold : bool, default=False
        Whether the values are a first guess, where the curvature of the bound says little of that at the end.
    """

    values: Values
    until: int
    after: Fit | None = None
    n_rows: int | None = None
    cold: bool = False

    @property
    def loss_curve(self) -> list[float]:
        """Of the iterations before its first."""
        return [] if self.after is None else self.after.loss_curve


# Yields starts, is sent how the fit from each ended, and returns the best of these.
Attempts = Generator[Attempt, Fit, Fit]


def better(best: Fit | None, fit: Fit) -> Fit:
    """The fit with the higher bound; of equals the later, which may have gone on from the other."""
    return fit if best is None or fit.rank >= best.rank else best


@dataclass(frozen=True)
class Strategy:
    """The decisions: from where a fit starts, given how the fits before it ended.

    Attributes
    ----------
    rules : Rules
    table : ParameterTable
        With first values and limits.
    max_iter : int
        Of each restart.
    n_restarts : int
    scatter : ndarray of shape (o,)
        Variance of what the features leave over.
    alone : float
        The bound of the features without a Gaussian process.
    noise_alone : ndarray of shape (o,), optional
        The noise variances with which it is.
    most_alone : float
        What it may be, and not more, where a kernel whose signal is fixed ends: that is known only then.
    noise_hidden : bool
        Whether it may be far above what the features leave over, from where no fit climbs to it.
    mean_precision : float
        Of the rows, where a row with the noise variance itself has 1.
    interpolates : bool
        Whether there are as many inducing points as rows.
    samples : tuple of int
        Sizes of the samples that a fit begins with.
    place : callable, optional
        Values -> the same values with inducing points placed anew under their kernel; None leaves them.
    restart : callable, optional
        () -> first values drawn at random.
    warm : dict, optional
        First values from another fit.
    placed : bool
        Whether the table's inducing points are from that fit.
    """

    rules: Rules
    table: ParameterTable
    max_iter: int
    n_restarts: int
    scatter: np.ndarray
    alone: float = -np.inf
    noise_alone: np.ndarray | None = None
    most_alone: float = -np.inf
    noise_hidden: bool = False
    mean_precision: float = 1.0
    interpolates: bool = False
    samples: tuple[int, ...] = ()
    place: Callable[[Values], Values] | None = None
    restart: Callable[[], Values] | None = None
    warm: Values | None = None
    placed: bool = False

    def attempts(self) -> Generator[Attempt, Fit, None]:
        """One start after the other; those from another fit come first, and cold ones only if these lead nowhere."""
        first = self.table.values_at_start()
        if self.warm is None:
            best = yield from self._released(self._climbing(first))
        else:
            # Inducing points that another fit moved have found their places.
            moved_before = self.placed or not np.array_equal(self.warm["inducing_points"], first["inducing_points"])
            again = self._once if moved_before else self._climbing
            best = yield from self._released(again(first | self.warm))
            if self.max_iter > 0 and self.collapsed(best):
                best = better(best, (yield from self._released(self._climbing(first))))
        if self.restart is not None and self.max_iter > 0 and self.table.size > 0:
            for _ in range(self.n_restarts):
                best = better(best, (yield from self._released(self._climbing(self.restart()))))
        if self._is_doubtful(best):
            yield from self._released(self._from_features_alone(first))

    def collapsed(self, fit: Fit) -> bool:
        """Whether noise came to explain everything, or the kernel explains less than nothing would."""
        if (fit.values["noise"] > self.rules.collapsed * self.scatter).any():
            return True
        return self._below(fit)

    def _below(self, fit: Fit, hopeless: bool = False) -> bool:
        """Whether it ended below the features alone; what has not ended yet may still rise, unless that is hopeless."""
        ended = hopeless or fit.converged or fit.n_iter < self.max_iter
        return fit.n_rows is None and ended and fit.bound < self.alone - _WORTH

    def _is_doubtful(self, best: Fit) -> bool:
        """Whether it ended below the features alone, or maybe did, and a fit could start from there."""
        free = self.table["noise"].free.any() or self.table["signal"].free.any()
        if self.noise_alone is None or self.max_iter == 0 or not free or not self.rules.last_start:
            return False
        maybe_below = best.n_rows is None and best.bound < self.most_alone - _WORTH
        return maybe_below or self._below(best, hopeless=self.noise_hidden)

    def _from_features_alone(self, first: Values) -> Attempts:
        """A fit with little signal, from the noise that suits the features alone."""
        assert self.noise_alone is not None
        little = np.minimum(first["signal"], _LITTLE * self.noise_alone / self.mean_precision)
        return (yield Attempt(first | {"signal": little, "noise": self.noise_alone}, self.max_iter))

    def _released(self, attempts: Attempts) -> Attempts:
        """Their best fit; one that ended at a limit goes on from there, where the table has a wider one."""
        best = yield from attempts
        if best.n_iter < self.max_iter and set(self.table.held(best.values)) - set(best.widened):
            best = better(best, (yield Attempt(best.values, self.max_iter, best)))
        return best

    def _climbing(self, values: Values) -> Attempts:
        """A fit to a sample of the rows, then on from there to larger ones, and at last to all.

        Most of what kernel and noise have to learn is learned from a few rows, where an iteration costs little.
        """
        stage = self.rules.stage
        if stage is None or not self.samples or self.max_iter == 0:
            return (yield from self._staged(values, self.max_iter))
        few, (smallest, *larger) = min(2 * stage, self.max_iter), self.samples
        best = yield from self._staged(values, few, smallest)
        for n_rows in larger:
            if self.collapsed(best):
                best = yield from self._staged(values, few, n_rows)
            else:
                best = yield Attempt(best.values, self.max_iter, n_rows=n_rows)
        if not self.collapsed(best):
            best = yield Attempt(best.values, self.max_iter)
            if not self.collapsed(best):
                return best
        return better(best, (yield from self._staged(values, self.max_iter)))

    def _staged(self, values: Values, max_iter: int, n_rows: int | None = None) -> Attempts:
        """A fit whose inducing points are placed anew under the kernel that the first iterations learned.

        (Burt et al. 2020 do so until it gains nothing; once gained nearly all here.) The first places cannot know which
        columns matter, and L-BFGS moves points a little, not across the data. A stage later the better of the two, the
        fit from the new places and that which went on from the old ones, goes on.
        """
        stage = self.rules.stage
        if (
            self.place is None
            or stage is None
            or max_iter <= stage
            or self.interpolates
            or not self.table["hyperparameters"].free.any()
        ):
            return (yield from self._unless_collapsed(values, max_iter, n_rows))
        first, until = (yield from self._unless_collapsed(values, stage, n_rows)), min(2 * stage, max_iter)
        best = better(first, (yield Attempt(self.place(first.values), until, first, n_rows)))
        if not first.converged:
            best = better(best, (yield Attempt(first.values, until, first, n_rows)))
        if not best.converged and best.n_iter < max_iter:
            best = better(best, (yield Attempt(best.values, max_iter, best, n_rows)))
        return best

    def _once(self, values: Values) -> Attempts:
        return (yield from self._unless_collapsed(values, self.max_iter))

    def _unless_collapsed(self, values: Values, until: int, n_rows: int | None = None) -> Attempts:
        """A fit from these values; from other starts too where it may have ended in a bad optimum."""

        def start(values: Values, cold: bool = True) -> Attempt:
            return Attempt(values, until, n_rows=n_rows, cold=cold)

        free = bool(self.table["noise"].free.any())
        much = self.rules.much_noise if free and (self.interpolates or n_rows is not None) else None
        best = yield start(values)
        if until == 0 or not free:
            return best
        if much is not None:
            best = better(best, (yield start(moved(values, 1.0, much), cold=n_rows is None)))
        tried = (1.0, much) if n_rows is None else None
        for factors in self.rules.other_starts:
            if not self.collapsed(best):
                break
            if factors == tried:
                continue
            best = better(best, (yield start(moved(values, *factors))))
        return best


def moved(values: Values, length_factor: float, noise_factor: float) -> Values:
    """The same values with other hyperparameters and another noise."""
    return values | {
        "hyperparameters": length_factor * values["hyperparameters"],
        "noise": noise_factor * values["noise"],
    }


def drawn(table: ParameterTable, rules: Rules, rng: np.random.RandomState) -> Values:
    """The table's first values with kernel and noise elsewhere, within their limits."""
    coordinates = table.coordinates(table.start())
    for name, factor in rules.restart_factors.items():
        reach = np.log(factor)
        coordinates[name] = coordinates[name] + rng.uniform(-reach, reach, coordinates[name].shape)
    return table.values(np.clip(table.flat(coordinates), *table.limits()))


def _after(attempts: Generator[Attempt, Fit, None], fit: Fit) -> Attempt | None:
    """The next attempt after a fit, if there is one."""
    try:
        return attempts.send(fit)
    except StopIteration:
        return None


class Task(Protocol):
    """A model to be fitted."""

    @property
    def strategy(self) -> Strategy:
        """From where."""

    @property
    def monitor(self) -> Monitor:
        """Told of each iteration."""

    def minimise(self, attempt: Attempt) -> Fit:
        """An optimiser's way from a start."""


def search(task: Task) -> Fit:
    """The best of all fits that the strategy asks for; after Ctrl-C, of those so far.

    Raises
    ------
    KeyboardInterrupt
        If there is none yet.
    """
    best: Fit | None = None
    strategy = task.strategy
    attempts = strategy.attempts()
    with task.monitor.keeping_the_best(patient=True):
        attempt: Attempt | None = next(attempts)
        while attempt is not None:
            fit = replace(task.minimise(attempt), widened=strategy.table.held(attempt.values))
            best = better(best, fit)
            attempt = None if task.monitor.stopped else _after(attempts, fit)
    if best is None:
        raise KeyboardInterrupt
    return best

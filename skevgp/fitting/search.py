"""The search over starts: from where a model is fitted, one start after the other, and which of the fits is kept.

A fit may end where the noise explains everything, or with inducing points where nothing happens: one start is not
enough. docs/guide/inside.md has a table of the rules, what each prevents, and the test that fails without it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ..model.parameters import ParameterTable, Values
from ..model.predictor import Predictor
from ..solvers.base import Solver
from ..utils.linalg import JITTER, Jitter

if TYPE_CHECKING:
    from .exact import ExactTask
    from .model import Model

# Nats: by less than this, a white kernel and noise are below each other by rounding.
_WORTH = 0.01
# Of a mean row's noise: so little signal costs next to nothing, and the gradient still tells whether it should grow.
_LITTLE = 1e-4
# Numbers: samples are held in memory.
LARGEST_SAMPLE = 2_000_000
# Of the exact model, where rounding does not matter before the noise is so low: a smooth function is met to 1e-6.
LOWEST_NOISE_EXACT = 1e-12


@dataclass(frozen=True)
class Rules:
    """The numbers that a search goes by; docs/guide/inside.md says what each prevents."""

    # Where the noise variance starts if the user does not say, as a share of what the features leave over. A low one
    # keeps L-BFGS out of the optimum where the noise explains everything.
    first_noise: float
    # Its lower limit in the same units. Below 1e-10, what rounding leaves of k(x, x) - |v|² in a sparse model
    # outweighs the noise.
    lowest_noise: float = 1e-10
    # The lower limit where inducing points are all rows, and the exact model's algebra takes the place of the sparse
    # one's; None keeps the sparse one's.
    lowest_noise_exact: float | None = None
    # Its upper limit, in units of the variance that the features leave over; of a fit that starts there or above, the
    # targets' variance if that is more.
    highest_noise: float = 1e2
    # Where lengthscales start, in standard deviations of their column, times √d: rows are then neither all alike nor
    # all strangers, whatever the number of columns.
    lengthscale: float = 0.6
    # In the same units, the lower one without √d.
    lengthscale_limits: tuple[float, float] = (1e-2, 1e4)
    # Of the signal variance, in units of the variance that the features leave over. From a first guess L-BFGS may
    # step far, and without an upper limit makes long waves of huge height from small ones.
    signal_limits: tuple[float, float] = (1e-8, 1e2)
    # The upper limit of a fit that starts where another ended at the first limit: polynomials, and sums of functions
    # of single columns, are to a stationary kernel a long lengthscale and a high signal. None leaves the fit there.
    widest_signal: float | None = 1e4
    # Of k(X_m, X_m).
    jitter: Jitter = JITTER
    # An output counts as not learned when noise comes to explain this share of what the features leave over.
    collapsed: float = 0.9
    # Where a collapsed fit starts again: factors on the first lengthscales and the first noise variance.
    other_starts: tuple[tuple[float, float], ...] = ()
    # Whether a fit that has ended below the features alone starts at last from the noise that suits these.
    last_start: bool = True
    # A start from a noise so many times higher comes after the first, where it costs little: on a sample of the rows,
    # or with as many inducing points as rows. The kernel may then explain every row by itself, and a low noise lead
    # to that plateau; a high one finds much noise sooner.
    much_noise: float | None = None
    # Iterations after which inducing points are placed anew, and so many again until it shows whether that was
    # better; on all rows, or on the smallest sample. None leaves the points.
    stage: int | None = None
    # Rows, and rows per inducing point and feature: so many are enough to begin with, the larger number counts. None
    # takes all.
    sample: tuple[int, int] | None = None
    # A sample is followed by one so many times larger; one of more than half of the rows, or of more numbers than
    # `LARGEST_SAMPLE`, is left out.
    growth: int = 4
    # A restart multiplies the first values by numbers between 1 / factor and the factor, drawn log-uniformly.
    restart_factors: dict[str, float] = field(default_factory=lambda: {"hyperparameters": 3.0, "noise": 30.0})

    def samples(self, n_rows: int, n_weights: int, width: int) -> tuple[int, ...]:
        """Sizes of the samples that a fit begins with; none if there are too few rows of ``width`` numbers."""
        if self.sample is None:
            return ()
        sizes, size = [], max(self.sample[0], self.sample[1] * n_weights)
        while size <= min(n_rows // 2, LARGEST_SAMPLE // width):
            sizes.append(size)
            size *= self.growth
        return tuple(sizes)


# For a solver that sees all rows, and for one that sees mini-batches. Adam's steps do not grow with the gradient: the
# noise starts nearer to the data's scatter, and inducing points stay where they are placed.
RULES = Rules(
    first_noise=1e-4,
    lowest_noise_exact=LOWEST_NOISE_EXACT,
    other_starts=((0.5, 1.0), (2.0, 100.0), (1.0, 1e3)),
    much_noise=1e3,
    stage=25,
    sample=(1000, 20),
)
MINI_BATCH_RULES = Rules(first_noise=1e-2, widest_signal=None, last_start=False)


def rules_of(solver: Solver) -> Rules:
    """The rules of a fit by this solver."""
    return MINI_BATCH_RULES if solver.stochastic else RULES


@dataclass(frozen=True)
class Fit:
    """Where an optimiser ended.

    ``bound`` is in nats, in internal units; -inf if it could not be computed. ``loss_curve`` is minus the bound per
    iteration, with that of the fits it went on from first. ``message`` says what the user should know of how it ended.
    ``predictor`` is there if q is not at its optimum for the values. ``n_rows`` is the size of the sample that was
    fitted, None for all rows. ``widened`` are the parameters that had their widest limits.
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
        """Number of iterations."""
        return len(self.loss_curve)

    @property
    def rank(self) -> tuple[float, float]:
        """The better of two fits has the higher rank: one to more rows, or else the higher bound."""
        return np.inf if self.n_rows is None else self.n_rows, self.bound


def better(best: Fit | None, fit: Fit) -> Fit:
    """The fit with the higher rank; of equals the later, which may have gone on from the other."""
    return fit if best is None or fit.rank >= best.rank else best


@dataclass(frozen=True)
class FeaturesAlone:
    """The bound of the features without a Gaussian process: a fit that ends below has failed.

    ``noise`` are the noise variances (o,) with which it is reached. ``most`` is what it may be, and no more, where that
    depends on where a kernel of fixed signal ends. ``hidden`` says that the noise may be far above what the features
    leave over, from where no fit climbs to it.
    """

    bound: float = -np.inf
    noise: np.ndarray | None = None
    most: float = -np.inf
    hidden: bool = False


@dataclass(frozen=True)
class Start:
    """From where a fit starts, and how far it may go.

    ``until`` is the most iterations, those of ``after`` among them, the fit to the same rows that it goes on from.
    ``n_rows`` is the size of the sample that is fitted, None for all rows. ``cold`` marks a first guess, where the
    curvature of the bound says little of that at the end.
    """

    values: Values
    until: int
    after: Fit | None = None
    n_rows: int | None = None
    cold: bool = False

    @property
    def loss_curve(self) -> list[float]:
        """Of the iterations before the first of this fit."""
        return [] if self.after is None else self.after.loss_curve


class _StoppedError(Exception):
    """Ctrl-C, or the end of the time: the best fit so far counts."""


def search(model: Model | ExactTask) -> Fit:
    """Fit a model from one start after the other; the best fit, after Ctrl-C of those so far.

    Raises
    ------
    KeyboardInterrupt
        If there is none yet.
    """
    found = Search(model)
    with model.monitor.keeping_the_best(patient=True), suppress(_StoppedError):
        found.run()
    if found.best is None:
        raise KeyboardInterrupt
    return found.best


class Search:
    """The fits of a model so far, and the best of them."""

    def __init__(self, model: Model | ExactTask):
        self.model, self.rules, self.table, self.max_iter = model, model.rules, model.table, model.max_iter
        self.best: Fit | None = None

    def run(self) -> None:
        """Fit from one start after the other; cold ones only if those from another fit lead nowhere."""
        first, warm = self.table.values_at_start(), self.model.warm
        if warm is None:
            best = self._released(self._climb(first))
        else:
            # Inducing points that another fit moved have found their places.
            moved_before = self.model.placed or not np.array_equal(warm["inducing_points"], first["inducing_points"])
            if moved_before:
                best = self._released(self._unless_collapsed(first | warm, self.max_iter))
            else:
                best = self._released(self._climb(first | warm))
            if self.max_iter > 0 and self.collapsed(best):
                best = better(best, self._released(self._climb(first)))
        if self.max_iter > 0 and self.table.size > 0:
            for _ in range(self.model.n_restarts):
                best = better(best, self._released(self._climb(self.model.restart())))
        if self._is_doubtful(best):
            # A fit with little signal, from the noise that suits the features alone.
            noise = self.model.alone.noise
            assert noise is not None
            little = np.minimum(first["signal"], _LITTLE * noise / self.model.mean_precision)
            self._released(self._fit(Start(first | {"signal": little, "noise": noise}, self.max_iter)))

    def _fit(self, start: Start) -> Fit:
        fit = replace(self.model.minimise(start), widened=self.table.held(start.values))
        self.best = better(self.best, fit)
        if self.model.monitor.stopped:
            raise _StoppedError
        return fit

    def _released(self, best: Fit) -> Fit:
        """A fit that ended at a limit goes on from there, where the table has a wider one."""
        if best.n_iter < self.max_iter and set(self.table.held(best.values)) - set(best.widened):
            best = better(best, self._fit(Start(best.values, self.max_iter, best)))
        return best

    def _climb(self, values: Values) -> Fit:
        """A fit to a sample of the rows, then on from there to larger ones, and at last to all.

        Most of what kernel and noise have to learn is learned from a few rows, where an iteration costs little.
        """
        stage, samples = self.rules.stage, self.model.samples
        if stage is None or not samples or self.max_iter == 0:
            return self._stages(values, self.max_iter)
        few = min(2 * stage, self.max_iter)
        best = self._stages(values, few, samples[0])
        for n_rows in samples[1:]:
            if self.collapsed(best):
                best = self._stages(values, few, n_rows)
            else:
                best = self._fit(Start(best.values, self.max_iter, n_rows=n_rows))
        if not self.collapsed(best):
            best = self._fit(Start(best.values, self.max_iter))
            if not self.collapsed(best):
                return best
        return better(best, self._stages(values, self.max_iter))

    def _stages(self, values: Values, max_iter: int, n_rows: int | None = None) -> Fit:
        """A fit whose inducing points are placed again under the kernel that the first iterations learned.

        (Burt et al. 2020 do so until it gains nothing; once gained nearly all here.) The first places cannot know which
        columns matter, and L-BFGS moves points a little, not across the data. A stage later the better of the two, the
        fit from the new places and that which went on from the old ones, goes on.
        """
        stage, place = self.rules.stage, self.model.place
        if (
            place is None
            or stage is None
            or max_iter <= stage
            or self.model.interpolates
            or not self.table["hyperparameters"].free.any()
        ):
            return self._unless_collapsed(values, max_iter, n_rows)
        first, until = self._unless_collapsed(values, stage, n_rows), min(2 * stage, max_iter)
        best = better(first, self._fit(Start(place(first.values), until, first, n_rows)))
        if not first.converged:
            best = better(best, self._fit(Start(first.values, until, first, n_rows)))
        if not best.converged and best.n_iter < max_iter:
            best = better(best, self._fit(Start(best.values, max_iter, best, n_rows)))
        return best

    def _unless_collapsed(self, values: Values, until: int, n_rows: int | None = None) -> Fit:
        """A fit from these values; from other starts too where it may have ended in a bad optimum."""
        free, everything = bool(self.table["noise"].free.any()), n_rows is None
        much = self.rules.much_noise if free and (self.model.interpolates or not everything) else None
        best = self._fit(Start(values, until, None, n_rows, cold=True))
        if until == 0 or not free:
            return best
        starts = list(self.rules.other_starts)
        if much is not None:
            start = Start(moved(values, 1.0, much), until, None, n_rows, cold=everything)
            best = better(best, self._fit(start))
            if everything:
                starts = [factors for factors in starts if factors != (1.0, much)]
        for factors in starts:
            if not self.collapsed(best):
                break
            start = Start(moved(values, *factors), until, None, n_rows, cold=True)
            best = better(best, self._fit(start))
        return best

    def collapsed(self, fit: Fit) -> bool:
        """Whether noise came to explain everything, or the kernel explains less than nothing would."""
        if (fit.values["noise"] > self.rules.collapsed * self.model.scatter).any():
            return True
        return self._below(fit)

    def _below(self, fit: Fit, hopeless: bool = False) -> bool:
        """Whether it ended below the features alone; what has not ended yet may still rise, unless that is hopeless."""
        ended = hopeless or fit.converged or fit.n_iter < self.max_iter
        return fit.n_rows is None and ended and fit.bound < self.model.alone.bound - _WORTH

    def _is_doubtful(self, best: Fit) -> bool:
        """Whether it ended below the features alone, or maybe did, and a fit could start from there."""
        alone, free = self.model.alone, self.table["noise"].free.any() or self.table["signal"].free.any()
        if alone.noise is None or self.max_iter == 0 or not free or not self.rules.last_start:
            return False
        maybe_below = best.n_rows is None and best.bound < alone.most - _WORTH
        return maybe_below or self._below(best, hopeless=alone.hidden)


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

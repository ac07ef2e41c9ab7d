"""The numbers that control a search, for solvers that see all rows and for those that see mini-batches."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..solvers.base import Solver
from ..utils.linalg import JITTER, Jitter

# Largest number of floats of a sample. Samples are held in memory.
LARGEST_SAMPLE = 2_000_000
# Lowest noise variance in squared target units: about the rounding error of the residuals.
LOWEST_NOISE = 1e-20
# Lower limit of the noise in the exact model. Above it, rounding does not matter. A smooth function is met to 1e-6.
LOWEST_NOISE_EXACT = 1e-12


@dataclass(frozen=True)
class Rules:
    """The numbers that control a search. docs/guide/inside.md says what each prevents."""

    # Default start of the noise variance, as a share of the residuals' variance. A low one keeps L-BFGS out of the
    # optimum where the noise explains everything.
    first_noise: float
    # Its lower limit in the same units. Below 1e-10, the rounding errors of k(x, x) - |v|² in a sparse model are larger
    # than the noise.
    lowest_noise: float = 1e-10
    # The lower limit if all rows are inducing points, so that the exact model is used. None: always the sparse model.
    lowest_noise_exact: float | None = None
    # Its upper limit, in units of the residuals' variance. A fit that starts there or above may go up to the targets'
    # variance.
    highest_noise: float = 1e2
    # Start of the length scales, in standard deviations of their column times √d. Rows are then neither all similar nor
    # all uncorrelated, for any number of columns.
    lengthscale: float = 0.6
    # Their limits in the same units. The lower one is without √d.
    lengthscale_limits: tuple[float, float] = (1e-2, 1e4)
    # Limits of the signal variance, in units of the residuals' variance. L-BFGS may step far from a first guess.
    # Without an upper limit it makes long waves of huge height from small ones.
    signal_limits: tuple[float, float] = (1e-8, 1e2)
    # The upper limit for a fit that continues another one from the first limit: for polynomials and for sums of
    # functions of single columns, a stationary kernel needs a long length scale and a high signal. None: no such fit.
    widest_signal: float | None = 1e4
    # Jitter of k(X_m, X_m).
    jitter: Jitter = JITTER
    # An output is not learned if the noise explains this share of the residuals' variance.
    collapsed: float = 0.9
    # Starts after a collapsed fit: factors on the first length scales and the first noise variance.
    other_starts: tuple[tuple[float, float], ...] = ()
    # A second start with shorter length scales: a factor on the first ones, and the share of the residuals' variance
    # that the noise must exceed. At long length scales, the gradient does not show waves that are much shorter.
    short: tuple[float, float] | None = None
    # Whether a fit that ended below the features alone starts once more, from the noise that is best for these.
    last_start: bool = True
    # Factor on the first noise for a second start, tried on a sample or with a point for each row, where it costs
    # little. A low noise may lead to a plateau where the kernel explains each row by itself.
    much_noise: float | None = None
    # Inducing points are placed again after ``stage`` iterations on all rows or on the smallest sample. After ``stage``
    # more, the better fit is kept. None: the points are placed once.
    stage: int | None = None
    # The first sample has so many rows, or so many per inducing point and feature if that is more. None: all rows.
    sample: tuple[int, int] | None = None
    # The same for the exact model, whose time grows with the cube of the rows: so many rows, or so many for each
    # learned number of kernel, noise and weights.
    exact_sample: tuple[int, int] | None = None
    # The next sample is so many times larger. Samples of more than half of the rows, or of more floats than
    # `LARGEST_SAMPLE`, are left out.
    growth: int = 4
    # Factor on the tolerance of a fit to all rows that moves along the curvature of a sample.
    last_share: float = 3.0
    # An exact fit to a sample shows no signal if it gains less than so many nats for each learned number of kernel,
    # signal and noise over the features alone.
    chance: float = 3.0
    # Before a fit to more rows, columns with length scales of more than so many times the first ones are tried with the
    # first ones. A small sample may not show that a column matters.
    longest: float = 3.0
    # The same before a fit to all rows, where a trial costs more.
    longest_of_all: float = 10.0
    # A fit that ends with noise below this share of the residuals' variance is tried with ten times the share: a small
    # sample may not show noise, and the gradient in the logarithm of a low noise is almost 0.
    low_noise: float = 1e-4
    # With fewer rows than this for each free number of kernel, signal and noise, these have a prior, whose weight falls
    # from 1 to 0 at so many rows, and predictions are averaged over draws of them (see `few_rows`). 0: never.
    few_rows: float = 12.0
    # A restart multiplies the first values by random numbers between 1 / factor and the factor, log-uniformly.
    restart_factors: dict[str, float] = field(default_factory=lambda: {"hyperparameters": 3.0, "noise": 30.0})

    def samples(self, n_rows: int, n_weights: int, width: int) -> tuple[int, ...]:
        """Sizes of the samples that a fit begins with. Empty if there are too few rows (of ``width`` numbers)."""
        if self.sample is None:
            return ()
        sizes, size = [], max(self.sample[0], self.sample[1] * n_weights)
        while size <= min(n_rows // 2, LARGEST_SAMPLE // width):
            sizes.append(size)
            size *= self.growth
        return tuple(sizes)

    def exact_samples(self, n_rows: int, n_learned: int) -> tuple[int, ...]:
        """The same for the exact model. Each is about twice as large as the one before it."""
        if self.exact_sample is None:
            return ()
        first = max(self.exact_sample[0], self.exact_sample[1] * n_learned)
        n_stages = max(0, round(np.log2(n_rows / first)))
        return tuple(np.rint(np.geomspace(first, n_rows, n_stages + 1)[:-1]).astype(int).tolist())


# Rules for a solver that sees all rows, and for one that sees mini-batches. Adam's steps do not grow with the gradient:
# the noise starts closer to the variance of the data, and inducing points are placed once.
RULES = Rules(
    first_noise=1e-4,
    lowest_noise_exact=LOWEST_NOISE_EXACT,
    other_starts=((0.5, 1.0), (2.0, 100.0), (1.0, 1e3)),
    much_noise=1e3,
    short=(0.3, 0.25),
    stage=25,
    sample=(1000, 20),
    exact_sample=(300, 20),
)
MINI_BATCH_RULES = Rules(first_noise=1e-2, widest_signal=None, last_start=False)


def rules_of(solver: Solver) -> Rules:
    """The rules for a solver."""
    return MINI_BATCH_RULES if solver.stochastic else RULES

"""The numbers that the strategy of a fit goes by; ARCHITECTURE.md has a table of what each prevents."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..utils.linalg import JITTER, Jitter

# Numbers: samples are held in memory.
LARGEST_SAMPLE = 2_000_000
# Of the exact model, where rounding does not matter before the noise is so low: a smooth function is met to 1e-6.
LOWEST_NOISE_EXACT = 1e-12


@dataclass(frozen=True)
class Rules:
    """What the strategy goes by: a property of the solver.

    Attributes
    ----------
    first_noise : float
        Where the noise variance starts if the user does not say, as a share of what the features leave over. A low one
        keeps L-BFGS out of the optimum where the noise explains everything.
    lowest_noise : float
        Its lower limit in the same units. Below 1e-10, what rounding leaves of k(x, x) - |v|² in a sparse model
        outweighs the noise.
    lowest_noise_exact : float, optional
        The lower limit where inducing points are all rows, and the exact model's algebra takes the place of the sparse
        one's; None keeps the sparse one's.
    highest_noise : float
        Its upper limit, in units of the variance that the features leave over; of a fit that starts there or above,
        the targets' variance if that is more.
    lengthscale : float
        Where lengthscales start, in standard deviations of their column, times √d: rows are then neither all alike nor
        all strangers, whatever the number of columns.
    lengthscale_limits : (float, float)
        In the same units, the lower one without √d.
    signal_limits : (float, float)
        Of the signal variance, in units of the variance that the features leave over. From a first guess L-BFGS may
        step far, and without an upper limit makes long waves of huge height from small ones.
    widest_signal : float, optional
        The upper limit of a fit that starts where another ended at the first limit: polynomials, and sums of functions
        of single columns, are to a stationary kernel a long lengthscale and a high signal. None leaves the fit there.
    jitter : Jitter
        Of k(X_m, X_m).
    collapsed : float
        An output counts as not learned when noise comes to explain this share of what the features leave over.
    other_starts : tuple of (float, float)
        Where a collapsed fit starts again: factors on the first lengthscales and the first noise variance.
    last_start : bool
        Whether a fit that has ended below the features alone starts at last from the noise that suits these.
    much_noise : float, optional
        A start from a noise so many times higher comes after the first, where it costs little: on a sample of the rows,
        or with as many inducing points as rows. The kernel may then explain every row by itself, and a low noise lead
        to that plateau; a high one finds much noise sooner.
    stage : int, optional
        Iterations after which inducing points are placed anew, and so many again until it shows whether that was
        better; on all rows, or on the smallest sample. None leaves the points.
    sample : (int, int), optional
        Rows, and rows per inducing point and feature: so many are enough to begin with, the larger number counts. None
        takes all.
    growth : int
        A sample is followed by one so many times larger; one of more than half of the rows, or of more numbers than
        `LARGEST_SAMPLE`, is left out.
    restart_factors : dict
        A restart multiplies the first values by numbers between 1 / factor and the factor, drawn log-uniformly.
    """

    first_noise: float
    lowest_noise: float = 1e-10
    lowest_noise_exact: float | None = None
    highest_noise: float = 1e2
    lengthscale: float = 0.6
    lengthscale_limits: tuple[float, float] = (1e-2, 1e4)
    signal_limits: tuple[float, float] = (1e-8, 1e2)
    widest_signal: float | None = 1e4
    jitter: Jitter = JITTER
    collapsed: float = 0.9
    other_starts: tuple[tuple[float, float], ...] = ()
    last_start: bool = True
    much_noise: float | None = None
    stage: int | None = None
    sample: tuple[int, int] | None = None
    growth: int = 4
    restart_factors: dict[str, float] = field(default_factory=lambda: {"hyperparameters": 3.0, "noise": 30.0})

    def samples(self, n_rows: int, n_weights: int, width: int) -> tuple[int, ...]:
        """The sizes of the samples that a fit begins with; none if there are too few rows.

        Parameters
        ----------
        n_rows : int
            In all.
        n_weights : int
            Inducing points and features.
        width : int
            Numbers in a row.

        Returns
        -------
        sizes : tuple of int
        """
        if self.sample is None:
            return ()
        sizes, size = [], max(self.sample[0], self.sample[1] * n_weights)
        while size <= min(n_rows // 2, LARGEST_SAMPLE // width):
            sizes.append(size)
            size *= self.growth
        return tuple(sizes)

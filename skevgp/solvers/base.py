"""The interface of solvers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.state import StatefulEstimator
from ..utils.validation import check_integer, check_real
from .coordinates import Coordinates, Metric, Scaled

# x -> (loss, gradient); may raise `NotPositiveDefiniteError` or return NaN away from the start.
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
# A loss counts as far if it is this much above the best loss, in units of the size of the best loss plus one.
_FAR = 10.0
# callback(iteration, lower_bound, outputs)
Callback = Callable[[int, float, Sequence[int]], object]


@dataclass
class Minimum:
    """Result of a solver. `others` are points that may be better, which the loss of a mini-batch does not tell."""

    x: np.ndarray
    loss: float
    loss_curve: list[float] = field(default_factory=list)
    converged: bool = False
    # The curvature near x, of a solver that looks for it.
    metric: Metric | None = None
    others: tuple[np.ndarray, ...] = ()

    @property
    def n_iter(self) -> int:
        """Number of iterations."""
        return len(self.loss_curve)


@dataclass(frozen=True)
class Tolerance:
    """Gain that an iteration needs: ``least``, or a ``share`` of the gain so far over a loss ``origin``."""

    least: float
    share: float = 0.0
    origin: float = 0.0

    def at(self, loss: float) -> float:
        """Return the tolerance at a loss, in its units."""
        return max(self.least, self.share * (self.origin - loss)) if np.isfinite(loss) else self.least


class Solver(StatefulEstimator):
    """A solver with its options; a subclass has `minimise`."""

    default_max_iter: ClassVar[int]  # for max_iter=None
    stochastic: ClassVar[bool] = False  # whether it takes mini-batches of the rows
    takes_any_objective: ClassVar[bool] = True  # such as one with a prior, or of a sample of the rows
    takes_widest_limits: ClassVar[bool] = False  # whether it gets the widest limits of signal and noise at once

    n_restarts: int
    callback: Callback | None
    posterior: Literal["full", "diagonal"]
    bound: Literal["titsias", "tight"] = "titsias"
    tol: float | Literal["auto"]
    max_time: float | None
    # Largest number of inducing points for n_inducing="auto". Only a solver that sees all rows uses it.
    max_inducing: int = 1000

    def check(self) -> None:
        """Raise an error if an option is out of range."""
        name = type(self).__name__
        check_integer(self.n_restarts, f"n_restarts of {name}", minimum=0)
        if self.callback is not None and not callable(self.callback):
            raise TypeError(f"callback of {name} must be None or a function; got {self.callback!r}.")
        if self.posterior not in ("full", "diagonal"):
            raise ValueError(f'posterior of {name} must be "full" or "diagonal"; got {self.posterior!r}.')
        if not isinstance(self.bound, str) or self.bound not in ("titsias", "tight"):
            raise ValueError(f'bound of {name} must be "titsias" or "tight"; got {self.bound!r}.')
        if self.max_time is not None:
            check_real(self.max_time, f"max_time of {name}", minimum=0.0, strict=True)
        if not (isinstance(self.tol, str) and self.tol == "auto"):
            check_real(self.tol, f"tol of {name}", minimum=0.0)


class MiniBatchSolver(Solver):
    """A solver that sees mini-batches of the rows. Its `minimise` has the arguments of `Adam.minimise`."""

    stochastic = True
    takes_any_objective = False

    batch_size: int = 256
    learning_rate: float = 0.01
    # Whether q moves by natural gradients.
    natural_gradient: bool = False


class Point(NamedTuple):
    """An evaluation of an objective."""

    x: np.ndarray
    loss: float
    gradient: np.ndarray


class Guarded:
    """An objective of z, the coordinates of x, that never raises nor returns NaN. It keeps the best x so far."""

    def __init__(self, objective: Objective, start: np.ndarray):
        self._objective = objective
        self.x, self.loss = start.copy(), np.inf
        anywhere = np.full(len(start), np.inf)
        self.coordinates: Coordinates = Scaled(np.ones(len(start)), (-anywhere, anywhere))
        self.last: Point | None = None

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        x, pull_back = self.coordinates.at(z)
        # SciPy evaluates its start, which is often the last point.
        if self.last is None or not np.array_equal(x, self.last.x):
            self.last = self._evaluated(x)
        # Points that overflow are recognised by their loss below.
        with np.errstate(over="ignore", invalid="ignore"):
            loss, gradient = self.last.loss, pull_back(self.last.gradient)
        # A line search that stepped too far interpolates back. From a loss of 1e10 it would take forever, or end within
        # rounding errors of its start. So losses far above the best are returned on a logarithmic scale, with the
        # gradient to match.
        far = _FAR * (1.0 + abs(self.loss))
        if not (np.isfinite(loss) and np.isfinite(gradient).all()):
            return (self.loss + far if np.isfinite(far) else 1e100), np.zeros_like(x)
        if loss < self.loss:
            self.x, self.loss = x.copy(), loss
        ratio = (loss - self.loss) / far
        if ratio > 1.0:
            return self.loss + far * (1.0 + np.log(ratio)), gradient / ratio
        return loss, gradient

    def at(self, z: np.ndarray) -> Point:
        """The evaluation at z."""
        self(z)
        assert self.last is not None  # as z was just evaluated
        return self.last

    def _evaluated(self, x: np.ndarray) -> Point:
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                loss, gradient = self._objective(x)
        except NotPositiveDefiniteError:
            return Point(x.copy(), np.nan, np.full_like(x, np.nan))
        return Point(x.copy(), loss, gradient.copy())

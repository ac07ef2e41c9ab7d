"""The interface of solvers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from ..utils.state import StatefulEstimator
from ..utils.validation import check_integer, check_real

# x -> (loss, gradient); may raise `NotPositiveDefiniteError` or return NaN away from the start.
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
# Lower and upper limits, each of the shape of x.
Limits = tuple[np.ndarray, np.ndarray]
# callback(iteration, lower_bound, outputs)
Callback = Callable[[int, float, Sequence[int]], object]


@dataclass
class Minimum:
    """Result of a solver. `others` are points that may be better, which the loss of a mini-batch does not tell."""

    x: np.ndarray
    loss: float
    loss_curve: list[float] = field(default_factory=list)
    converged: bool = False
    others: tuple[np.ndarray, ...] = ()

    @property
    def n_iter(self) -> int:
        """Number of iterations."""
        return len(self.loss_curve)


class Solver(StatefulEstimator):
    """A solver with its options; a subclass has `minimise`."""

    default_max_iter: ClassVar[int]  # for max_iter=None
    stochastic: ClassVar[bool]  # whether it takes mini-batches of the rows

    n_restarts: int
    callback: Callback | None
    posterior: Literal["full", "diagonal"]
    tol: float | Literal["auto"]
    max_time: float | None

    def check(self) -> None:
        """Raise an error if an option is out of range."""
        name = type(self).__name__
        check_integer(self.n_restarts, f"n_restarts of {name}", minimum=0)
        if self.callback is not None and not callable(self.callback):
            raise TypeError(f"callback of {name} must be None or a function; got {self.callback!r}.")
        if self.posterior not in ("full", "diagonal"):
            raise ValueError(f'posterior of {name} must be "full" or "diagonal"; got {self.posterior!r}.')
        if self.max_time is not None:
            check_real(self.max_time, f"max_time of {name}", minimum=0.0, strict=True)
        if not (isinstance(self.tol, str) and self.tol == "auto"):
            check_real(self.tol, f"tol of {name}", minimum=0.0)

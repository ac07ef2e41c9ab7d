"""What every optimiser is given and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

# x -> (loss, gradient); may raise `NotPositiveDefiniteError` or return NaN away from the start.
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
# Lower and upper limits, each of the shape of x.
Limits = tuple[np.ndarray, np.ndarray]


@dataclass
class Minimum:
    """What an optimiser found.

    Attributes
    ----------
    x : ndarray
        The best point seen.
    loss : float
        Its value.
    loss_curve : list of float
        The loss per iteration.
    converged : bool
        Whether the optimiser's own rule ended it: not the number of iterations, an error or Ctrl-C.
    others : tuple of ndarray
        Where losses are noisy: points that may be better.
    """

    x: np.ndarray
    loss: float
    loss_curve: list[float] = field(default_factory=list)
    converged: bool = False
    others: tuple[np.ndarray, ...] = ()

    @property
    def n_iter(self) -> int:
        return len(self.loss_curve)

"""One run of a solver: where it starts (`Start`), how it ends (`Fit`), and the bound that it must reach."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..model.parameters import Values
from ..model.predictor import Predictor
from ..solvers.coordinates import Metric


@dataclass(frozen=True)
class Fit:
    """The end of one run of an optimiser."""

    values: Values
    # In nats, in internal units. -inf if it could not be computed.
    bound: float
    # Minus the bound per iteration, including the fits that this one continues.
    loss_curve: list[float] = field(default_factory=list)
    converged: bool = True
    # For the user. Empty if all is well.
    message: str = ""
    # Only if q is not at its optimum for the values.
    predictor: Predictor | None = None
    # Size of the sample that was fitted. None: all rows.
    n_rows: int | None = None
    # The ends of other starts on all rows, if rows are few.
    others: tuple[Values, ...] = ()
    # Names of the parameters that had their widest limits.
    widened: tuple[str, ...] = ()
    # The curvature near its end.
    metric: Metric | None = None

    @property
    def n_iter(self) -> int:
        """Number of iterations."""
        return len(self.loss_curve)

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key for the better of two fits: more rows first, then the higher bound."""
        return np.inf if self.n_rows is None else self.n_rows, self.bound


def better(best: Fit | None, fit: Fit) -> Fit:
    """The fit with the higher rank. Of equal ones the later, which may have continued the other."""
    return fit if best is None or fit.rank >= best.rank else best


@dataclass(frozen=True)
class FeaturesAlone:
    """The bound of the features without a Gaussian process. A fit that ends below it has failed."""

    bound: float
    # (o,): the noise variances that reach the bound.
    noise: np.ndarray
    # An upper limit of the bound, if it depends on the end of a kernel with a fixed signal.
    most: float = -np.inf
    # Whether the noise may be far above the residuals, so that no fit climbs to it.
    hidden: bool = False


@dataclass(frozen=True)
class Start:
    """The start of a fit, and its limit of iterations."""

    values: Values
    # Largest number of iterations, including those of ``after``.
    until: int
    # The fit to the same rows that this one continues.
    after: Fit | None = None
    # Size of the sample to fit. None: all rows.
    n_rows: int | None = None
    # Whether the values are a first guess. The curvature of the bound there says little about its end.
    cold: bool = False
    # The curvature near the values, from an earlier fit.
    metric: Metric | None = None

    @property
    def loss_curve(self) -> list[float]:
        """The loss of each iteration before this fit."""
        return [] if self.after is None else self.after.loss_curve

"""Fit the exact model: where it starts, from where else it is tried, what the user should know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..inference.exact import ExactModel
from ..inference.posterior import Posterior
from ..inference.statistics import Kernel
from ..kernels.parse import Starts
from ..optimizers.lbfgs import Minimum, Report
from ..optimizers.parameters import ParameterTable
from ..rows.internal import Rows
from .advice import far_from_prior, how_it_ended, nothing_learned
from .descent import lbfgs_unless_stuck, moved_start
from .start import FIRST_NOISE, checked_variance, spread_of, starting_table
from .units import Frame

# On so many rows it is seen whether a user's kernel works.
_CHECKED_ROWS = 500


@dataclass(frozen=True)
class ExactOptions:
    """How to optimise.

    Attributes
    ----------
    max_iter : int
    tol : float
        In nats.
    n_restarts : int
    """

    max_iter: int
    tol: float
    n_restarts: int = 0


@dataclass(frozen=True)
class ExactFit:
    """The exact model of some outputs, fitted.

    Attributes
    ----------
    frame : Frame
    model : ExactModel
    table : ParameterTable
        Where it started, and its bounds.
    minimum : Minimum
        In internal units, per row.
    message : str
        What the user should know of how it ended; empty if it converged.
    """

    frame: Frame
    model: ExactModel
    table: ParameterTable
    minimum: Minimum
    message: str

    @classmethod
    def fit(
        cls,
        frame: Frame,
        rows: Rows,
        kernel: Kernel,
        starts: Starts,
        vague: np.ndarray,
        options: ExactOptions,
        rng: np.random.RandomState,
        reporter: Callable[[float], Report] | None = None,
    ) -> ExactFit:
        """Maximise the log marginal likelihood.

        Parameters
        ----------
        frame : Frame
        rows : Rows
            In internal units.
        kernel : Kernel
        starts : Starts
            What the user says of kernel and noise.
        vague : ndarray of shape (o, p)
            Weights with an infinite prior scale.
        options : ExactOptions
        rng : RandomState
            Draws the restarts.
        reporter : callable, default=None
            reporter(what to subtract from a loss in internal units) returns the fit's report.

        Returns
        -------
        fitted : ExactFit

        Raises
        ------
        ValueError
            If features with vague weights depend on each other, or the kernel does not work.
        """
        n = len(rows)
        everything = rows.some(np.arange(n))
        _check_independent(everything.features, vague)
        first, variance = starts.hyperparameters.value, 1.0
        if first is not None:
            some = np.unique(np.linspace(0, n - 1, _CHECKED_ROWS).astype(int))
            variance = checked_variance(kernel, first, everything.inputs[some])
        spread = spread_of(rows.inputs)
        table = starting_table(
            spread,
            np.empty((1, 0, len(spread))),
            frame.target_unit,
            starts,
            rows.scatter(),
            FIRST_NOISE["lbfgs"],
            kernel.n_hyperparameters,
            variance,
        )
        model = ExactModel(kernel, frame.internal_prior(), vague, everything)
        shown = None if reporter is None else reporter(_shift(frame, vague, n))
        report = None if shown is None else lambda iteration, loss: shown(iteration, n * loss)
        best = _maximise(model, table, rows, options, rng, report)
        proper = replace(model.prior, reference=np.where(vague, 0.0, model.prior.reference))
        advice = [how_it_ended(best, options.max_iter, 0, options.tol, sparse=False), far_from_prior(proper, rows)]
        if not best.interrupted and options.max_iter > 0 and table["noise"].free.any():
            advice.append(nothing_learned(table.values(best.x)["noise"], rows, sparse=False))
        return cls(frame, model, table, best, " ".join(part for part in advice if part))

    def posterior(self) -> Posterior:
        """The posterior of all outputs, in the user's units but for target_mean."""
        return self.frame.posterior([self.model.posterior(self.table.values(self.minimum.x))])

    @property
    def log_marginal_likelihood(self) -> float:
        """In nats, summed over outputs."""
        outputs = self.model.outputs(self.table.values(self.minimum.x))[1]
        return sum(output.log_likelihood for output in outputs) - self._shift

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the log marginal likelihood per iteration."""
        return self._n_rows * np.array(self.minimum.loss_curve) + self._shift

    def bounds(self, name: str, output: int) -> np.ndarray:
        """Bounds (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        bounds = self.table[name].value_bounds()
        return bounds[[output]] * self.frame.target_unit[output] ** 2 if name == "signal" else bounds

    @property
    def _n_rows(self) -> int:
        return len(self.model.rows.inputs)

    @property
    def _shift(self) -> float:
        return _shift(self.frame, self.model.vague, self._n_rows)


def _maximise(
    model: ExactModel,
    table: ParameterTable,
    rows: Rows,
    options: ExactOptions,
    rng: np.random.RandomState,
    report: Report | None,
) -> Minimum:
    """L-BFGS on the log marginal likelihood from the table's start, then from others; the best is kept."""
    n = len(rows)

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        likelihood, gradient = model.log_likelihood(table.values(flat))
        return -likelihood / n, -table.flat(gradient) / n

    def descend(start: ParameterTable) -> Minimum:
        return lbfgs_unless_stuck(
            loss, start, rows.scatter(), options.max_iter, options.tol / n, may_interpolate=True, report=report
        )

    best = descend(table)
    for _ in range(options.n_restarts if options.max_iter > 0 and table.size > 0 else 0):
        if best.interrupted:
            break
        other = descend(table.started_at(moved_start(table, rng)))
        best = other if other.loss < best.loss else replace(best, interrupted=other.interrupted)
    return best


def _shift(frame: Frame, vague: np.ndarray, n_rows: int) -> float:
    """From internal units to the user's, for a loss of all rows: each contrast has a unit."""
    return float(((n_rows - vague.sum(axis=1)) * np.log(frame.target_unit)).sum())


def _check_independent(features: np.ndarray, vague: np.ndarray) -> None:
    """Refuse features whose vague weights the rows cannot tell apart."""
    size = np.sqrt(np.sum(features**2, axis=0))
    scaled = features / np.where(size > 0.0, size, 1.0)
    for mask in np.unique(vague, axis=0):
        rank = np.linalg.matrix_rank(scaled[:, mask]) if mask.any() else 0
        if rank < mask.sum():
            raise ValueError(
                f"coef_scale=inf needs features that are linearly independent on the rows of X: {mask.sum()} features "
                f"have an infinite scale, but only {rank} of them are independent. Give some a finite scale."
            )

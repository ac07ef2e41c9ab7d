"""What is kept of a sparse model when it is fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from ..data.internal import Rows
from ..model.bounds import bounds_at_optimum
from ..model.exact import ExactModel
from ..model.model import SparseModel
from ..model.objectives import evaluate
from ..model.parameters import ParameterTable, Values
from ..model.predictor import Predictor
from ..model.statistics import SufficientStatistics, Whitening
from .advice import far_from_prior, signal_gone
from .calibrate import calibrated
from .rules import Rules
from .sparse import SparseTask
from .strategy import Fit

# Signal over noise variance: above it the jitter of k(X_m, X_m), up to 1e-12 and more of the signal, shows in the std.
_HIGH_RATIO = 1e9


class Doubts(Protocol):
    """How much each row is doubted (`noise.outliers`)."""

    def weigh(self, rows: Rows) -> Rows:
        """Rows as the rest of the model sees them."""

    def told(self, learned: Learned) -> Learned:
        """What is said of the noise is that of rows that are no outliers."""

    def updated(self, learned: Learned, rows: Rows) -> Learned:
        """Fold new rows in, which are doubted as well."""


@dataclass(frozen=True)
class Learned:
    """A fitted sparse model.

    Attributes
    ----------
    model : SparseModel
    table : ParameterTable
        Where it started, and its limits.
    values : dict
        Of the model's parameters, in internal units.
    statistics : list of SufficientStatistics
        At ``values``, one for each set of inducing points.
    predictor : Predictor
        In internal units.
    loss_curve : list of float
        Minus the bound per iteration.
    message : str
        What the user should know of how the fit ended; empty if all is well.
    dependent : bool, default=False
        Whether rows near each other were found to be alike.
    doubts : Doubts, optional
        Of the rows, if the noise has heavy tails.
    known_bound, known_upper_bound : float, optional
        `bound` and `upper_bound`, where they are known better than from the statistics.
    exact : bool, default=False
        Whether the predictor is the exact model's (`SparseTask.exact`).
    """

    model: SparseModel
    table: ParameterTable
    values: Values
    statistics: list[SufficientStatistics]
    predictor: Predictor
    loss_curve: list[float]
    message: str
    dependent: bool = False
    doubts: Doubts | None = None
    known_bound: float | None = None
    known_upper_bound: float | None = None
    exact: bool = False

    @cached_property
    def bound(self) -> float:
        """On the log marginal likelihood, in nats, of the residuals in internal units."""
        return self.model.bound(self.values, self.statistics) if self.known_bound is None else self.known_bound

    @cached_property
    def upper_bound(self) -> float:
        """What it cannot exceed."""
        if self.known_upper_bound is not None:
            return self.known_upper_bound
        return self.model.upper_bound(self.values, self.statistics)

    @classmethod
    def of(cls, task: SparseTask, fit: Fit, doubts: Doubts | None = None) -> Learned:
        """What is kept of a fit; signal and noise are calibrated if the task says so and Ctrl-C did not."""
        model, values, exact = task.model, fit.values, task.exact
        advice, found, dependent = [fit.message, far_from_prior(model.prior, task.rows)], None, False
        statistics = model.statistics(values, task.blocks)
        if not task.monitor.stopped and task.max_iter > 0:
            advice.append(task.learned_too_little(values))
            if task.noise_cv is not None:
                # The algebra of folds is the sparse model's.
                lowest = task.solver.rules.lowest_noise * task.rows.scatter()
                noisy = values if exact is None else values | {"noise": np.maximum(values["noise"], lowest)}
                with task.monitor.keeping_the_best():
                    found = calibrated(model, noisy, statistics, task.table, task.rows, task.noise_cv, task.seed)
                dependent = found is not None and found.dependent
                if exact is not None and task.noise_cv.groups is None:
                    # What folds correct, that inducing points represent too little, is no matter here.
                    found = None
        if found is not None:
            values = values | {"signal": found.signal, "noise": found.noise}
            advice.append(signal_gone(found.gone, len(found.noise)))
        # Else summed row by row, which keeps its digits where the noise is low.
        known = found is None and np.isfinite(fit.bound) and fit.n_rows is None
        if exact is None:
            bound = fit.bound if known else model.bound(values, statistics, task.blocks)
            upper_bound = model.upper_bound(values, statistics, task.blocks)
        else:
            bound = upper_bound = fit.bound if known else float(exact.log_likelihoods(values).sum())
        if exact is not None and (values["signal"] > _HIGH_RATIO * values["noise"]).any():
            predictor = exact.predictor(values)
        elif found is None and fit.predictor is not None:
            exact, predictor = None, fit.predictor
        else:
            exact, predictor = None, model.at_optimum(values, statistics, blocks=task.blocks)
        learned = cls(
            model,
            task.table,
            values,
            statistics,
            predictor,
            fit.loss_curve,
            " ".join(part for part in advice if part),
            dependent,
            known_bound=bound,
            known_upper_bound=upper_bound,
            exact=exact is not None,
        )
        return learned if doubts is None else doubts.told(replace(learned, doubts=doubts))

    def bound_at(
        self, rows: Rows, output: int, hyperparameters: np.ndarray, signal: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """The bound of one output under another kernel, and its gradient in the kernel's logarithms.

        Noise and inducing points are the fitted ones, and q is at its optimum.

        Parameters
        ----------
        rows : Rows
            Those of the fit, of this output.
        output : int
            Of the model's outputs.
        hyperparameters : ndarray of shape (n_hyper,)
            Of k̃.
        signal : ndarray of shape (1,)
            s².

        Returns
        -------
        bound : float
        gradient : ndarray of shape (n_hyper + 1,)
            That in log s² last.
        """
        own, index = slice(output, output + 1), self.model.set_of(output, self.table["inducing_points"])
        rows = rows if self.doubts is None else self.doubts.weigh(rows)
        points = self.values["inducing_points"][[index]]
        values = {
            "hyperparameters": hyperparameters,
            "signal": signal,
            "noise": self.values["noise"][own],
            "inducing_points": points,
        }
        kernel, _ = self.model.kernel_of(self.values, index)
        prior = self.model.prior.outputs(own)
        if self.exact:
            vague = np.zeros(prior.scale.shape, dtype=bool)
            alone = ExactModel(kernel, prior, vague, rows.some(np.arange(len(rows))))
            bound, gradient = alone.log_likelihood(values)
        else:
            model = replace(self.model, kernel=kernel, prior=prior, groups=(slice(0, 1),), kernels=None)
            blocks = model.blocks(rows, points.shape[1])
            bound, gradient = evaluate(model, values, blocks, partial(bounds_at_optimum, family=model.family))
        return bound, np.append(gradient["hyperparameters"], gradient["signal"])

    def updated(self, rows: Rows, weight: float = 1.0) -> Learned:
        """Fold new rows in: same kernel and inducing points, q at its optimum for all rows so far.

        ``weight`` multiplies the log likelihood of the earlier rows.
        """
        if self.doubts is not None:
            return self.doubts.updated(self, rows)
        n_inducing = self.values["inducing_points"].shape[1]
        # Whatever its points were of the rows before.
        model, values = replace(self.model, complete=False), self.values
        if self.exact:
            # From here on the points are some rows of many, with the sparse model's algebra and its lowest noise.
            lowest = np.where(self.table["noise"].free, Rules.lowest_noise, 0.0)
            values = values | {"noise": np.maximum(values["noise"], lowest)}
            whitenings = list(model.whitenings(values))
        else:
            whitenings = [group.whitening for group in self.predictor.groups]
        new = model.statistics(values, model.blocks(rows, n_inducing), whitenings)
        statistics = [old.scaled(weight) + more for old, more in zip(self.statistics, new, strict=True)]
        learned = replace(self, model=model, values=values, statistics=statistics, exact=False)
        return learned._at_optimum(whitenings)

    def _at_optimum(self, whitenings: list[Whitening]) -> Learned:
        predictor = self.model.at_optimum(self.values, self.statistics, whitenings)
        learned = replace(self, predictor=predictor, known_bound=None, known_upper_bound=None)
        return learned if self.doubts is None else self.doubts.told(learned)

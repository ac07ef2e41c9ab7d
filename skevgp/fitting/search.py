"""The search over starts: where each fit of a model starts, and which fit is kept.

A fit may end where the noise explains everything, or with inducing points where nothing happens. One start is not
enough. docs/guide/inside.md has a table of the rules, what each prevents, and the test that fails without it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..model.parameters import Values
from .model import LITTLE, Model
from .runs import Fit, Start, better

# In nats. With a smaller difference, rounding decides whether a white kernel or noise has the higher bound.
_WORTH = 0.01
# In nats. More rows show that a column matters if its first length scale raises the bound by more.
_SEEN = 1.0


class _StoppedError(Exception):
    """Ctrl-C was pressed or the time is over. The best fit so far is the result."""


def search(model: Model) -> Fit:
    """Fit a model from one start after another and return the best fit. After Ctrl-C, it is the best so far.

    Raises KeyboardInterrupt if there is none yet.
    """
    fits = Search(model)
    with model.monitor.keeping_the_best(patient=True), suppress(_StoppedError):
        fits.run()
    if fits.best is None:
        raise KeyboardInterrupt
    return replace(fits.best, others=tuple(fits.ends))


class Search:
    """The best fit of a model so far, and the rules for the next start."""

    def __init__(self, model: Model):
        self.model, self.rules, self.table, self.max_iter = model, model.rules, model.table, model.max_iter
        self.best: Fit | None = None
        # The ends of starts on all rows.
        self.ends: list[Values] = []

    def run(self) -> None:
        """Fit from one start after another. If the start from an earlier fit fails, cold starts follow."""
        first, warm = self.table.values_at_start(), self.model.warm
        if warm is None:
            best = self._released(self._climb(first))
        else:
            # Inducing points that another fit moved are in good places.
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
            # A fit with little signal, from the noise that is best for the features alone.
            noise = self.model.alone.noise
            little = np.minimum(first["signal"], LITTLE * noise / self.model.mean_precision)
            self._released(self._fit(Start(first | {"signal": little, "noise": noise}, self.max_iter)))

    def _fit(self, start: Start) -> Fit:
        """Run the solver once and keep the best fit. Raise `_StoppedError` after Ctrl-C."""
        fit = replace(self.model.minimise(start), widened=self.table.held(start.values))
        self.best = better(self.best, fit)
        if fit.n_rows is None and self.model.hyper_prior is not None:
            self.ends.append(fit.values)
        if self.model.monitor.stopped:
            raise _StoppedError
        return fit

    def _released(self, best: Fit) -> Fit:
        """Continue a fit that ended at a limit, if the table has a wider one."""
        if best.n_iter < self.max_iter and set(self.table.held(best.values)) - set(best.widened):
            best = better(best, self._fit(Start(best.values, self.max_iter, best)))
        return best

    def _with_noise(self, best: Fit) -> Fit:
        """Continue a fit that ended almost without noise, if the bound is higher with noise."""
        low = (best.values["noise"] < self.rules.low_noise * self.model.scatter) & self.table["noise"].free
        if low.any() and best.n_iter < self.max_iter:
            noise = np.where(low, 10.0 * self.rules.low_noise * self.model.scatter, best.values["noise"])
            values = best.values | {"noise": noise}
            if self.model.bound_at(values) > best.bound + _WORTH:
                best = better(best, self._fit(Start(values, self.max_iter, best)))
        return best

    def _climb(self, values: Values) -> Fit:
        """Fit a sample of the rows, continue on larger samples, and at last on all rows.

        Kernel and noise learn most from a few rows, where an iteration costs little.
        """
        stage, samples = self.rules.stage, self.model.samples
        if stage is None or not samples or self.max_iter == 0:
            return self._stages(values, self.max_iter)
        few = min(2 * stage, self.max_iter)
        best = self._stages(values, few, samples[0])
        for n_rows in samples[1:]:
            if self._lost(best):
                best = self._stages(values, few, n_rows)
            else:
                best = self._fit(self._continued(best, values, n_rows))
        if not self._lost(best):
            best = self._with_noise(self._fit(self._continued(best, values)))
            if not self.collapsed(best):
                return best
        return better(best, self._stages(values, self.max_iter))

    def _continued(self, fit: Fit, first: Values, n_rows: int | None = None) -> Start:
        """The start of a fit to more rows, with the first length scales of columns that these show to matter."""
        # The gradient of a long length scale is almost 0, so that an optimiser does not shorten it. One column after
        # another is tried, and stays short if that raises the bound.
        name, values = "hyperparameters", fit.values
        longest = self.rules.longest_of_all if n_rows is None else self.rules.longest
        long = (values[name] > longest * first[name]) & self.model.lengthscale_mask
        long &= self.table[name].free.reshape(long.shape)
        columns = np.flatnonzero(long.any(axis=tuple(range(long.ndim - 1))))
        bound = self.model.bound_at(values, n_rows) if len(columns) else 0.0
        for column in columns:
            tried = long & (np.arange(long.shape[-1]) == column)
            trial = values | {name: np.where(tried, first[name], values[name])}
            bound_of_trial = self.model.bound_at(trial, n_rows)
            if bound_of_trial > bound + _SEEN:
                values, bound = trial, bound_of_trial
        return Start(values, self.max_iter, n_rows=n_rows, metric=fit.metric if self.model.keeps_metric else None)

    def _stages(self, values: Values, max_iter: int, n_rows: int | None = None) -> Fit:
        """Fit in stages: after the first iterations, inducing points are placed again under the learned kernel."""
        # (Burt et al. 2020 repeat this until nothing is gained. Once gained almost all here.) The first places cannot
        # know which columns matter, and L-BFGS moves points a little, not across the data. One stage later, the better
        # of two fits continues: from the new places, or from the old ones.
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
        """Fit from these values, and from other starts if the fit may have ended in a bad optimum."""
        free, everything = bool(self.table["noise"].free.any()), n_rows is None
        much = self.rules.much_noise if free and (self.model.interpolates or not everything) else None
        best = self._fit(Start(values, until, None, n_rows, cold=True))
        # The start does not depend on the values: restarts do not repeat it.
        selected = self.model.by_forward_selection() if everything and until > 0 and len(self.ends) == 1 else None
        if selected is not None:
            best = better(best, self._fit(Start(values | selected, until, None, cold=True)))
        if until == 0 or not free:
            return best
        starts = list(self.rules.other_starts)
        if much is not None:
            start = Start(multiplied(values, 1.0, much), until, None, n_rows, cold=everything)
            best = better(best, self._fit(start))
            if everything:
                starts = [factors for factors in starts if factors != (1.0, much)]
        if self.rules.short is not None and selected is None:
            factor, share = self.rules.short
            if (best.values["noise"] > share * self.model.scatter).any():
                best = better(best, self._fit(Start(multiplied(values, factor, 1.0), until, None, n_rows, cold=True)))
        for factors in starts:
            if not self.collapsed(best):
                break
            start = Start(multiplied(values, *factors), until, None, n_rows, cold=True)
            best = better(best, self._fit(start))
        return best

    def collapsed(self, fit: Fit) -> bool:
        """Whether the noise explains everything, or the kernel makes the bound worse than the features alone."""
        if (fit.values["noise"] > self.rules.collapsed * self.model.scatter).any():
            return True
        return self._below(fit)

    def _lost(self, fit: Fit) -> bool:
        """Whether a fit to a sample found no signal. More rows may show one, from the first values."""
        return self.collapsed(fit) or not self.model.shows_signal(fit)

    def _bound(self, fit: Fit) -> float:
        """The bound of a fit without the prior of kernel and noise, which the features alone do not have."""
        return fit.bound - self.model.log_hyper_prior(fit.values)

    def _below(self, fit: Fit, hopeless: bool = False) -> bool:
        """Whether a fit ended below the features alone. One that has not ended may still rise, unless ``hopeless``."""
        ended = hopeless or fit.converged or fit.n_iter < self.max_iter
        return fit.n_rows is None and ended and self._bound(fit) < self.model.alone.bound - _WORTH

    def _is_doubtful(self, best: Fit) -> bool:
        """Whether the best fit is, or may be, below the features alone, and another start could help."""
        free = self.table["noise"].free.any() or self.table["signal"].free.any()
        if self.max_iter == 0 or not free or not self.rules.last_start:
            return False
        alone = self.model.alone
        maybe_below = best.n_rows is None and self._bound(best) < alone.most - _WORTH
        return maybe_below or self._below(best, hopeless=alone.hidden)


def multiplied(values: Values, length_factor: float, noise_factor: float) -> Values:
    """The same values with hyperparameters and noise multiplied by factors."""
    return values | {
        "hyperparameters": length_factor * values["hyperparameters"],
        "noise": noise_factor * values["noise"],
    }

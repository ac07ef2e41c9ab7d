"""The fitted models of all outputs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..data.internal import Rows
from ..data.source import Source
from ..model.parameters import Values
from ..model.predictor import Predictor
from ..model.statistics import Kernel
from .learned import Learned
from .outliers import RowDoubts
from .units import Units


@dataclass(frozen=True)
class FittedOutputs:
    """The fitted sparse models of all outputs.

    Attributes
    ----------
    units : Units
    outputs : list of list of int
        Of each model.
    found : bool
        Whether which outputs share a model was found and not given.
    learned : tuple of Learned
        Each model, in internal units.
    messages : tuple of str
        What the user should know of how the fits ended.
    """

    units: Units
    outputs: list[list[int]]
    found: bool
    learned: tuple[Learned, ...]
    messages: tuple[str, ...]

    @property
    def row_scales(self) -> np.ndarray | None:
        """E[τ] of each row and model, (n, n_models); None if the noise is Gaussian."""
        each = [one.doubts.scales.mean for one in self.learned if isinstance(one.doubts, RowDoubts)]
        return np.column_stack(each) if each else None

    def updated(self, source: Source, weight: float = 1.0, row_variance: np.ndarray | None = None) -> FittedOutputs:
        """Fold new rows into the predictors; ``weight`` multiplies what is known of the others."""
        rows = self.units.rows(source)
        models = zip(self.outputs, self.learned, strict=True)
        learned = (one.updated(rows.outputs(own).noisier(row_variance), weight) for own, one in models)
        return replace(self, learned=tuple(learned))

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""
        return self.units.predictor([one.predictor for one in self.learned], self.outputs)

    @property
    def dependent(self) -> bool:
        """Whether rows near each other were found to be alike."""
        return any(one.dependent for one in self.learned)

    @property
    def lower_bound(self) -> float:
        """In nats, summed over outputs."""
        return sum(one.bound for one in self.learned) - self._shift

    @property
    def upper_bound(self) -> float:
        """On the log marginal likelihood, in nats, summed over outputs."""
        return sum(one.upper_bound for one in self.learned) - self._shift

    @property
    def n_iter(self) -> int:
        """Iterations of the longest fit."""
        return max(len(one.loss_curve) for one in self.learned)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,); a model that is done keeps its last value."""
        if self.n_iter == 0:
            return np.empty(0)
        # One that had nothing to learn made no iterations.
        curves = [one.loss_curve or [-one.bound] for one in self.learned]
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def n_parameters(self) -> int:
        """Free parameters of kernels, noise, inducing points and q."""
        total = 0
        for one in self.learned:
            n_outputs, p = one.model.prior.scale.shape
            m, of_weights = one.values["inducing_points"].shape[1], p + p * (p + 1) // 2
            of_values = m + m * (m + 1) // 2 + m * p
            if one.model.family == "diagonal":
                of_values, of_weights = 2 * m, 2 * p
            total += one.table.size + n_outputs * of_values
            total += of_weights * (1 if one.model.prior.shared else n_outputs)
        return total

    @property
    def sharing(self) -> list[list[int]]:
        """Outputs by what they are fitted with: of a model, or of a group that is joined to others by weights alone."""
        found = []
        for outputs, one in zip(self.outputs, self.learned, strict=True):
            separate = one.values["hyperparameters"].ndim == 2
            found += [outputs[group] for group in one.model.groups] if separate else [outputs]
        return sorted(found)

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        model, within = self._place_of(output)
        table = self.learned[model].table
        limits = table[name].value_limits()
        if name == "signal":
            # Calibrated, it may have left them.
            (low, high), signal = limits[within], self.learned[model].values["signal"][within]
            return np.array([[min(low, signal), max(high, signal)]]) * self.units.target_unit[output] ** 2
        if table[name].start.ndim == 1:
            return limits
        return limits.reshape(*table[name].start.shape, 2)[self.learned[model].model.set_of(within, table[name])]

    def bound_at(self, rows: Rows, output: int, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """The bound of one output under another kernel, and its gradient in the kernel's logarithms.

        Parameters
        ----------
        rows : Rows
            Those of the fit.
        output : int
        numbers : ndarray of shape (n_hyper + 1,)
            Hyperparameters of k̃, and s², in the user's units.

        Returns
        -------
        bound : float
            In nats, in the user's units.
        gradient : ndarray of shape (n_hyper + 1,)
        """
        (model, within), own = self._place_of(output), [output]
        internal, n_rows = numbers[-1] / self.units.target_unit[own] ** 2, self.learned[model].statistics[0].n_rows
        bound, gradient = self.learned[model].bound_at(rows.outputs(own), within, numbers[:-1], internal)
        return bound - n_rows * self.units.log_unit(own), gradient

    def _place_of(self, output: int) -> tuple[int, int]:
        """Which model an output belongs to, and which of the model's it is."""
        return next((i, own.index(output)) for i, own in enumerate(self.outputs) if output in own)

    def values_in(self, units: Units, rows: Rows, kernel: Kernel, model: int) -> Values:
        """A model's values in other internal units, as far as they can serve another fit."""
        one, own, inputs = self.learned[model], self.outputs[model], rows.inputs
        values, points = one.values, one.values["inducing_points"]
        if inputs.mean.ndim == 2 and one.model.kernels is None:
            inputs = inputs.at(own)
        if points.shape[2] != inputs.mean.shape[-1] or (inputs.mean.ndim == 2 and len(points) != len(inputs.mean)):
            return {}
        lowest, highest = (edge.reshape(-1, 1, points.shape[2]) for edge in (inputs.lowest, inputs.highest))
        outside = (points < 2.0 * lowest - highest) | (points > 2.0 * highest - lowest)
        # A few may have gone far where functions are smooth; of most it means that the rows are others.
        if outside.any(axis=-1).mean() > 0.5:
            return {}
        ratio = (self.units.target_unit[own] / units.target_unit[own]) ** 2
        found = {"noise": values["noise"] * ratio, "inducing_points": points}
        if one.model.kernel == kernel:
            found |= {"hyperparameters": values["hyperparameters"], "signal": values["signal"] * ratio}
        return found

    @property
    def _shift(self) -> float:
        """From internal units to the user's, for a loss of all rows."""
        return self.learned[0].statistics[0].n_rows * self.units.log_unit(slice(None))

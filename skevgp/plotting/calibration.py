"""CalibrationDisplay: coverage of intervals against their probability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ..metrics import calibration_error, interval_levels
from ..utils.scorers import mean_and_std
from ..utils.validation import check_integer
from ._style import axes_of, free_color

_DIAGONAL = "as promised"
# Begin of the gid of a band; the number of values follows.
_BAND = "calibration band "


class CalibrationDisplay:
    """Reliability curve: coverage of central intervals against their probability.

    Intervals are too narrow below the diagonal, and too wide above it. The shaded area contains 95 % of the curves of
    calibrated models with independent rows. Rows of a trajectory are not independent. If curves of several models share
    axes, the area is that of the smallest number of values.

    Parameters
    ----------
    nominal : ndarray of shape (n_levels,)
        Probabilities of the intervals, from 0 to 1.
    observed : ndarray of shape (n_curves, n_levels)
        Shares of values inside the intervals.
    errors : ndarray of shape (n_curves,)
        `skevgp.metrics.calibration_error` of each curve.
    n_values : int
        Number of values of each curve.
    names : sequence of str of length n_curves, default=None
        Names of the outputs, if each output has a curve.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.
    lines_ : list of matplotlib Line2D
        Lines of the curves.

    See Also
    --------
    CalibrationDisplay.from_estimator : Make one from a fitted regressor.
    CalibrationDisplay.from_predictions : Make one from means and standard deviations.
    skevgp.metrics.calibration_error : Area between curve and diagonal.
    sklearn.calibration.CalibrationDisplay : Calibration of class probabilities.

    References
    ----------
    - V. Kuleshov, N. Fenner, S. Ermon (2018): Accurate Uncertainties for Deep Learning Using Calibrated Regression.

    Examples
    --------
    >>> from sklearn.linear_model import BayesianRidge
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.plotting import CalibrationDisplay
    >>> (X, y), (X_test, y_test) = (make_toy(random_state=seed, return_X_y=True) for seed in (0, 1))
    >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
    >>> display = CalibrationDisplay.from_estimator(model, X_test, y_test)
    >>> display = CalibrationDisplay.from_estimator(BayesianRidge().fit(X, y), X_test, y_test, ax=display.ax_)
    >>> legend = display.ax_.legend()
    """

    def __init__(
        self,
        nominal: np.ndarray,
        observed: np.ndarray,
        errors: np.ndarray,
        n_values: int,
        names: Sequence[str] | None = None,
    ):
        self.nominal = nominal
        self.observed = observed
        self.errors = errors
        self.n_values = n_values
        self.names = names

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: ArrayLike,
        y: ArrayLike,
        *,
        per_output: bool = False,
        output_names: Sequence[str] | None = None,
        n_levels: int = 101,
        ax: Any = None,
        label: str | None = None,
        color: str | None = None,
    ) -> Self:
        """Predict, compare with observations, and draw.

        Parameters
        ----------
        estimator : regressor
            Fitted regressor with ``predict(X, return_std=True)``, or a wrapper of such a regressor (see
            `skevgp.metrics.make_std_scorer`).
        X : array-like of shape (n_samples, n_features)
            Rows that were not in the fit.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Observations at these rows.
        per_output : bool, default=False
            Whether to draw a curve for each output instead of one for all values.
        output_names : sequence of str of length n_outputs, default=None
            Names of the outputs for ``per_output``. If None, output 0, output 1, ...
        n_levels : int, default=101
            Number of probabilities at which the curves are evaluated, at least 2.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        label : str, default=None
            Name of the curve, for ``display.ax_.legend()``. If None, the name of the class, or of the output.
        color : str, default=None
            Colour of the curve, as in `plot`.

        Returns
        -------
        display : CalibrationDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError, TypeError
            As for `from_predictions`, and if the estimator has no standard deviation.
        """
        return cls.from_predictions(
            y,
            *mean_and_std(estimator, X),
            per_output=per_output,
            output_names=output_names,
            n_levels=n_levels,
            ax=ax,
            label=type(estimator).__name__ if label is None and not per_output else label,
            color=color,
        )

    @classmethod
    def from_predictions(
        cls,
        y_true: ArrayLike,
        y_pred: ArrayLike,
        std: ArrayLike,
        *,
        per_output: bool = False,
        output_names: Sequence[str] | None = None,
        n_levels: int = 101,
        ax: Any = None,
        label: str | None = None,
        color: str | None = None,
    ) -> Self:
        """Compare predictions with observations, and draw.

        Parameters
        ----------
        y_true, y_pred, std : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Observations, predicted means and predicted standard deviations (with noise).
        per_output : bool, default=False
            Whether to draw a curve for each output instead of one for all values.
        output_names : sequence of str of length n_outputs, default=None
            Names of the outputs for ``per_output``. If None, output 0, output 1, ...
        n_levels : int, default=101
            Number of probabilities at which the curves are evaluated, at least 2.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        label : str, default=None
            Name of the curve, for ``display.ax_.legend()``.
        color : str, default=None
            Colour of the curve, as in `plot`.

        Returns
        -------
        display : CalibrationDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError, TypeError
            If shapes differ, a value is not finite, or a standard deviation is negative. If the number of names is not
            that of the outputs, or ``n_levels`` is not an integer of at least 2.
        """
        check_integer(n_levels, "n_levels", minimum=2)
        levels = interval_levels(y_true, y_pred, std)
        names = None
        if per_output:
            names = [f"output {index}" for index in range(levels.shape[1])]
            names = names if output_names is None else list(output_names)
            if len(names) != levels.shape[1]:
                raise ValueError(f"output_names must name the {levels.shape[1]} outputs; got {names}.")
        own = [levels.ravel()] if names is None else list(levels.T)
        nominal = np.linspace(0.0, 1.0, n_levels)
        observed = np.array([np.searchsorted(np.sort(each), nominal, side="right") / len(each) for each in own])
        y_true, y_pred, std = (np.asarray(part, dtype=float).reshape(levels.shape) for part in (y_true, y_pred, std))
        columns = zip(y_true.T, y_pred.T, std.T, strict=True)
        errors = (
            [calibration_error(*one) for one in columns] if per_output else [calibration_error(y_true, y_pred, std)]
        )
        return cls(nominal, observed, np.array(errors), len(own[0]), names).plot(ax, label=label, color=color)

    def plot(self, ax: Any = None, *, label: str | None = None, color: str | None = None) -> Self:
        """Draw the display.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        label : str, default=None
            Name of the curve, for ``display.ax_.legend()``. Names of outputs and the calibration error are appended.
        color : str, default=None
            Colour of a single curve. If None, the first colour of a colour-blind-safe palette that is not on the axes
            yet.

        Returns
        -------
        self : CalibrationDisplay
            The display itself, with ``ax_`` and ``figure_``.
        """
        ax = axes_of(ax)
        self._plot_band(ax)
        if _DIAGONAL not in {line.get_label() for line in ax.lines}:
            ax.plot([0.0, 1.0], [0.0, 1.0], color="0.5", linewidth=1.0, linestyle="--", label=_DIAGONAL)
            ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect="equal")
            ax.set_xlabel("probability of the interval")
            ax.set_ylabel("share of values inside")
        self.lines_ = []
        for index, (curve, error) in enumerate(zip(self.observed, self.errors, strict=True)):
            name = ", ".join(filter(None, [label, None if self.names is None else self.names[index]]))
            single = color if self.names is None else None
            said = f"{name} (error {error:.3f})" if name else f"error {error:.3f}"
            options = {"color": single or free_color(ax), "label": said, "clip_on": False}
            self.lines_ += ax.plot(self.nominal, curve, **options)
        self.ax_, self.figure_ = ax, ax.figure
        return self

    def _plot_band(self, ax: Any) -> None:
        """Draw the band of curves by chance, unless the axes have that of fewer values."""
        bands = {band: int(band.get_gid()[len(_BAND) :]) for band in ax.collections if _is_band(band)}
        if min(bands.values(), default=self.n_values + 1) <= self.n_values:
            return
        for band in bands:
            band.remove()
        half = 1.96 * np.sqrt(self.nominal * (1.0 - self.nominal) / self.n_values)
        low, high = (np.clip(self.nominal + sign * half, 0.0, 1.0) for sign in (-1.0, 1.0))
        ax.fill_between(self.nominal, low, high, color="0.5", alpha=0.25, linewidth=0, gid=f"{_BAND}{self.n_values}")


def _is_band(artist: Any) -> bool:
    return (artist.get_gid() or "").startswith(_BAND)

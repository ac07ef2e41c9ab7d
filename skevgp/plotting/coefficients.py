"""CoefficientDisplay: weights of the explicit features, before and after the fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ..utils.validation import check_fitted
from ._style import BLUE, axes_of, check_output

if TYPE_CHECKING:
    from ..estimators.evgp import EVGPRegressor


class CoefficientDisplay:
    """Prior and posterior weights of the explicit features, with error bars.

    The plot also shows posteriors as numbers, because a bar may be shorter than its symbol.

    Parameters
    ----------
    names : sequence of str
        Names of the weights.
    mean, std, prior_mean, prior_std : ndarray of shape (n_weights,)
        Posterior and prior means and standard deviations of the weights.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    CoefficientDisplay.from_estimator : Make one from a fitted regressor.

    Examples
    --------
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.plotting import CoefficientDisplay
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(PolynomialFeatures(1), n_inducing=10, random_state=0).fit(X, y)
    >>> CoefficientDisplay.from_estimator(model).names
    ['1', 'x0']
    """

    def __init__(
        self,
        names: list[str],
        mean: np.ndarray,
        std: np.ndarray,
        prior_mean: np.ndarray,
        prior_std: np.ndarray,
    ):
        self.names = names
        self.mean = mean
        self.std = std
        self.prior_mean = prior_mean
        self.prior_std = prior_std

    @classmethod
    def from_estimator(cls, estimator: EVGPRegressor, *, output: int = 0, ax: Any = None, n_std: float = 2.0) -> Self:
        """Take the weights from a fitted regressor, and draw.

        Parameters
        ----------
        estimator : EVGPRegressor
            Fitted regressor with a feature map.
        output : int, default=0
            Index of the output whose weights are drawn.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        n_std : float, default=2.0
            Half length of the bars, in standard deviations.

        Returns
        -------
        display : CoefficientDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError
            If the regressor has no explicit features, or there is no such output.
        """
        check_fitted(estimator)
        if not hasattr(estimator, "coef_"):
            raise ValueError("The regressor has no weights to show: it was fitted with feature_map=None.")
        n_outputs = len(np.atleast_2d(estimator.coef_))
        check_output(output, n_outputs)
        names = list(estimator.coef_names_)
        parts = (
            np.atleast_2d(part)[output]
            for part in (
                estimator.coef_,
                estimator.coef_std_,
                estimator.coef_prior_mean_,
                estimator.coef_prior_scale_,
            )
        )
        return cls(names, *parts).plot(ax=ax, n_std=n_std)

    def plot(self, ax: Any = None, *, n_std: float = 2.0) -> Self:
        """Draw the display.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        n_std : float, default=2.0
            Half length of the bars, in standard deviations.

        Returns
        -------
        self : CoefficientDisplay
            The display itself, with ``ax_`` and ``figure_``.
        """
        ax = axes_of(ax)
        places = np.arange(len(self.names))[::-1]
        for mean, std, shift, colour, marker, label in (
            (self.prior_mean, self.prior_std, 0.12, "0.55", "s", "prior"),
            (self.mean, self.std, -0.12, BLUE, "o", "posterior"),
        ):
            ax.errorbar(
                mean,
                places + shift,
                xerr=n_std * std,
                fmt=marker,
                color=colour,
                capsize=3,
                label=f"{label} ±{n_std:g} std",
            )
        for place, mean, half in zip(places, self.mean, n_std * self.std, strict=True):
            beside = {"transform": ax.get_yaxis_transform(), "va": "center", "color": BLUE}
            ax.text(1.02, place, _in_numbers(mean, half), **beside)
        ax.axvline(0.0, color="0.85", linewidth=0.8, zorder=0)
        ax.set_yticks(places, self.names)
        ax.margins(x=0.1)
        ax.set_ylim(-0.6, len(self.names) - 0.4)
        ax.set_xlabel("weight")
        self.ax_, self.figure_ = ax, ax.figure
        return self


def _in_numbers(mean: float, half: float) -> str:
    """Format a mean, to the digit that its bar leaves certain, and the bar."""
    decimals = int(np.clip(-np.floor(np.log10(half)), 0, 6)) if half > 0.0 else 3
    return f"{round(mean, decimals) + 0.0:.{decimals}f} ± {half:.1g}"

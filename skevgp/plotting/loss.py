"""LossDisplay: the bound over the iterations of a fit."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from sklearn.pipeline import Pipeline

from ..utils.validation import check_fitted
from ._style import axes_of, free_color

# Least number of iterations of a fit whose first quarter is not shown.
_LONG = 20


class LossDisplay:
    """Bound on the log marginal likelihood after each iteration of a fit.

    Curves of several fits can share axes. With the same rows and features, the model with the higher bound is better.

    Parameters
    ----------
    bound : ndarray of shape (n_iter,)
        Bound after each iteration, in nats.
    bound_name : str, default="lower bound (nats)"
        Label of the vertical axis.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.
    line_ : matplotlib Line2D
        Line of the bound.

    See Also
    --------
    LossDisplay.from_estimator : Make one from a fitted regressor.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.plotting import LossDisplay
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
    >>> display = LossDisplay.from_estimator(model, gap=True)
    >>> len(display.bound) == model.n_iter_
    True
    """

    def __init__(self, bound: np.ndarray, bound_name: str = "lower bound (nats)"):
        self.bound = bound
        self.bound_name = bound_name

    @classmethod
    def from_estimator(
        cls, estimator: Any, *, gap: bool = False, ax: Any = None, label: str | None = None, color: str | None = None
    ) -> Self:
        """Take the bound from a fitted regressor, and draw.

        Parameters
        ----------
        estimator : EVGPRegressor, EGPRegressor or BayesianMLPRegressor
            Fitted regressor with at least one iteration, or a pipeline that ends with one. Values of Adam are estimates
            from mini-batches.
        gap : bool, default=False
            Whether to draw the distance to the best bound, as in `plot`.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        label, color : str, default=None
            Name and colour of the line, as in `plot`.

        Returns
        -------
        display : LossDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError
            If there are no iterations, for example after ``max_iter=0``.
        """
        check_fitted(estimator)
        while isinstance(estimator, Pipeline):
            estimator = estimator[-1]
        bound = -np.asarray(getattr(estimator, "loss_curve_", []), dtype=float)
        bound[~np.isfinite(bound)] = np.nan  # a user's optimizer may have tried points that cannot be evaluated
        if not np.isfinite(bound).any():
            raise ValueError(
                f"{type(estimator).__name__} has no iterations to show: it has no loss_curve_, or an empty one."
            )
        exact = hasattr(estimator, "log_marginal_likelihood_value_")
        name = "log marginal likelihood (nats)" if exact else "lower bound (nats)"
        return cls(bound, name).plot(ax, gap=gap, label=label, color=color)

    def plot(self, ax: Any = None, *, gap: bool = False, label: str | None = None, color: str | None = None) -> Self:
        """Draw the display.

        Without ``gap``, the vertical axis of a fit of 20 iterations or more leaves out the first quarter, because its
        large gain would hide all later gains.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        gap : bool, default=False
            Whether to draw the distance to the best bound on a logarithmic scale, which shows the last part of a fit.
        label : str, default=None
            Name of the line, for ``display.ax_.legend()``.
        color : str, default=None
            Colour. If None, the first colour of a colour-blind-safe palette that is not on the axes yet.

        Returns
        -------
        self : LossDisplay
            The display itself, with ``ax_`` and ``figure_``.
        """
        ax = axes_of(ax)
        others = [ax.get_ylim()] if ax.lines else []
        iterations = np.arange(1, len(self.bound) + 1)
        below = np.nanmax(self.bound) - self.bound
        values = np.where(below > 0.0, below, np.nan) if gap else self.bound
        options = {"color": free_color(ax) if color is None else color, "label": label}
        (self.line_,) = ax.plot(iterations, values, **options, marker="." if len(iterations) < 30 else None)
        if gap:
            ax.set_yscale("log")
        else:
            known = self.bound[np.isfinite(self.bound)]
            late = known[len(known) // 4 :] if len(known) >= _LONG else known
            margin = 0.05 * (late.max() - late.min()) or 1.0
            ax.set_ylim(
                min(late.min() - margin, *(low for low, _ in others), np.inf),
                max(known.max() + margin, *(high for _, high in others), -np.inf),
            )
        ax.set_xlabel("iteration")
        ax.set_ylabel(f"{self.bound_name.removesuffix(' (nats)')}: nats below its best" if gap else self.bound_name)
        self.ax_, self.figure_ = ax, ax.figure
        return self

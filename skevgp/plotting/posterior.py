"""PosteriorDisplay: predictions along a line."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_consistent_length, check_is_fitted

from ._style import BLUE, GREEN, ORANGE, axes_of, check_output


def _one_output(y: ArrayLike, output: int) -> np.ndarray:
    values = np.asarray(y, dtype=float)
    return values.reshape(len(values), -1)[:, output]


class PosteriorDisplay:
    """Predicted mean with its credible interval, along one axis.

    Parameters
    ----------
    x : ndarray of shape (n_samples,)
        Positions of the predictions.
    mean, std : ndarray of shape (n_samples,)
        Predicted means and standard deviations.
    y : ndarray of shape (n_samples,), default=None
        Observations at the same positions.
    inducing_points : ndarray of shape (m,), default=None
        Inducing points, drawn as crosses along the lower edge.
    x_train, y_train : ndarray of shape (n_train,), default=None
        Observations at other positions, drawn as dots.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    PosteriorDisplay.from_estimator : Make one from a fitted regressor.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.plotting import PosteriorDisplay
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
    >>> X_grid = np.linspace(-1, 7, 50)[:, np.newaxis]
    >>> display = PosteriorDisplay.from_estimator(model, X_grid, x_train=X[:, 0], y_train=y)
    """

    def __init__(
        self,
        x: np.ndarray,
        mean: np.ndarray,
        std: np.ndarray,
        y: np.ndarray | None = None,
        inducing_points: np.ndarray | None = None,
        x_train: np.ndarray | None = None,
        y_train: np.ndarray | None = None,
    ):
        self.x = x
        self.mean = mean
        self.std = std
        self.y = y
        self.inducing_points = inducing_points
        self.x_train = x_train
        self.y_train = y_train

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: ArrayLike,
        y: ArrayLike | None = None,
        *,
        output: int = 0,
        x: ArrayLike | None = None,
        x_train: ArrayLike | None = None,
        y_train: ArrayLike | None = None,
        ax: Any = None,
        n_std: float = 2.0,
        label: str = "mean",
    ) -> Self:
        """Predict and draw.

        Parameters
        ----------
        estimator : regressor
            Fitted regressor with ``predict(X, return_std=True)``.
        X : array-like of shape (n_samples, n_features)
            Rows to predict.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
            Observations at these rows.
        output : int, default=0
            Index of the output to draw.
        x : array-like of shape (n_samples,), default=None
            Values along the horizontal axis, for example times. If None, the only column of X, or the row numbers.
        x_train : array-like of shape (n_train,), default=None
            Positions of further observations, for example those of the fit.
        y_train : array-like of shape (n_train,) or (n_train, n_outputs), default=None
            Further observations.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        n_std : float, default=2.0
            Half width of the interval, in standard deviations.
        label : str, default="mean"
            Name of the line of the mean, for ``display.ax_.legend()``.

        Returns
        -------
        display : PosteriorDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError
            If y or x does not have a value for each row of X, or there is no such output. If x_train and y_train differ
            in length, or only one of them is given.
        """
        check_is_fitted(estimator)
        mean, std = (part.reshape(len(part), -1) for part in estimator.predict(X, return_std=True))
        check_output(output, mean.shape[1])
        mean, std = mean[:, output], std[:, output]
        values = np.asarray(X)
        one_column = values.ndim == 2 and values.shape[1] == 1
        if x is None:
            x = values[:, 0] if one_column else np.arange(len(mean))
        points = getattr(estimator, "inducing_points_", None)
        if points is not None and one_column and getattr(estimator, "kernel_map_", None) is None:
            points = points[..., 0] if points.ndim == 2 else points[output, :, 0]
        else:
            points = None
        places = np.asarray(x, dtype=float)
        check_consistent_length(mean, places, y)
        observed = None if y is None else _one_output(y, output)
        if (x_train is None) != (y_train is None):
            raise ValueError(f"x_train and y_train go together; {'x' if x_train is None else 'y'}_train is None.")
        training: tuple[np.ndarray, ...] = ()
        if x_train is not None and y_train is not None:
            check_consistent_length(x_train, y_train)
            training = np.ravel(np.asarray(x_train, dtype=float)), _one_output(y_train, output)
        return cls(places, mean, std, observed, points, *training).plot(ax=ax, n_std=n_std, label=label)

    def plot(self, ax: Any = None, *, n_std: float = 2.0, label: str = "mean") -> Self:
        """Draw the display.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        n_std : float, default=2.0
            Half width of the interval, in standard deviations.
        label : str, default="mean"
            Name of the line of the mean, for ``display.ax_.legend()``.

        Returns
        -------
        self : PosteriorDisplay
            The display itself, with ``ax_`` and ``figure_``.
        """
        ax = axes_of(ax)
        order = np.argsort(self.x, kind="stable")
        x, mean, std = self.x[order], self.mean[order], self.std[order]
        low, high = mean - n_std * std, mean + n_std * std
        ax.fill_between(x, low, high, color=BLUE, alpha=0.2, linewidth=0, label=f"±{n_std:g} std")
        ax.plot(x, mean, color=BLUE, label=label)
        if self.y is not None:
            ax.plot(x, self.y[order], color=ORANGE, linestyle="--", label="observed")
        if self.x_train is not None:
            ax.plot(self.x_train, self.y_train, ".", color="0.35", markersize=3, zorder=1, label="training data")
        if self.inducing_points is not None:
            # On the lower edge for any limits: x in data units, y in axes units.
            ax.plot(
                self.inducing_points,
                np.full(len(self.inducing_points), 0.03),
                "x",
                color=GREEN,
                transform=ax.get_xaxis_transform(),
                label="inducing points",
            )
        self.ax_, self.figure_ = ax, ax.figure
        return self

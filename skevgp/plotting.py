"""Pictures in scikit-learn's Display convention: ``from_estimator`` computes, ``plot`` draws. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone
from sklearn.utils import _safe_indexing, check_random_state
from sklearn.utils.validation import _num_samples, check_consistent_length, check_is_fitted

from ._optional import require
from ._validation import check_integer
from .metrics import prediction_error

if TYPE_CHECKING:
    from .regressor import EVGPRegressor

__all__ = ["CoefficientDisplay", "LearningCurveDisplay", "PosteriorDisplay"]

# Blue and orange of Okabe & Ito's palette, safe for colour-blind readers.
_MODEL, _TRUTH, _INDUCING = "#0072B2", "#D55E00", "#009E73"


def _axes(ax: Any) -> Any:
    pyplot = require("matplotlib.pyplot", "Plotting")
    return ax if ax is not None else pyplot.subplots()[1]


def _check_output(output: int, n_outputs: int) -> None:
    if not -n_outputs <= output < n_outputs:
        raise ValueError(f"output={output!r} must be the index of one of {n_outputs} outputs.")


class PosteriorDisplay:
    """Predicted mean with a band of standard deviations, along one axis.

    Parameters
    ----------
    x : ndarray of shape (n_samples,)
        Where the predictions are.
    mean, std : ndarray of shape (n_samples,)
    y : ndarray of shape (n_samples,), default=None
        Observations at the same places.
    inducing_points : ndarray of shape (m,), default=None
        Drawn as crosses along the lower edge.

    Attributes
    ----------
    ax_ : matplotlib Axes
    figure_ : matplotlib Figure

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
    >>> display = PosteriorDisplay.from_estimator(model, np.linspace(-1, 7, 50)[:, np.newaxis])
    """

    def __init__(
        self,
        x: np.ndarray,
        mean: np.ndarray,
        std: np.ndarray,
        y: np.ndarray | None = None,
        inducing_points: np.ndarray | None = None,
    ):
        self.x = x
        self.mean = mean
        self.std = std
        self.y = y
        self.inducing_points = inducing_points

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: ArrayLike,
        y: ArrayLike | None = None,
        *,
        output: int = 0,
        x: ArrayLike | None = None,
        ax: Any = None,
        n_std: float = 2.0,
        label: str = "mean",
    ) -> Self:
        """Predict and draw.

        Parameters
        ----------
        estimator : regressor
            Fitted; its ``predict`` takes ``return_std``.
        X : array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
            Observations at these rows.
        output : int, default=0
            Which output to draw.
        x : array-like of shape (n_samples,), default=None
            Values along the horizontal axis, for example times; by default the only column of X, or the row numbers.
        ax : matplotlib Axes, default=None
            Where to draw; by default on new axes.
        n_std : float, default=2.0
            Half width of the band, in standard deviations.
        label : str, default="mean"
            Name of the mean's line, for ``display.ax_.legend()``.

        Returns
        -------
        display : PosteriorDisplay

        Raises
        ------
        ValueError
            If y or x does not have a value per row of X, or there is no such output.
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        check_is_fitted(estimator)
        mean, std = (part.reshape(len(part), -1) for part in estimator.predict(X, return_std=True))
        _check_output(output, mean.shape[1])
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
        observed = None if y is None else np.asarray(y, dtype=float).reshape(len(mean), -1)[:, output]
        return cls(places, mean, std, observed, points).plot(ax=ax, n_std=n_std, label=label)

    def plot(self, ax: Any = None, *, n_std: float = 2.0, label: str = "mean") -> Self:
        """Draw.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            By default new axes.
        n_std : float, default=2.0
            Half width of the band, in standard deviations.
        label : str, default="mean"
            Name of the mean's line, for ``display.ax_.legend()``.

        Returns
        -------
        self : object

        Raises
        ------
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        ax = _axes(ax)
        order = np.argsort(self.x, kind="stable")
        x, mean, std = self.x[order], self.mean[order], self.std[order]
        low, high = mean - n_std * std, mean + n_std * std
        ax.fill_between(x, low, high, color=_MODEL, alpha=0.2, linewidth=0, label=f"±{n_std:g} std")
        ax.plot(x, mean, color=_MODEL, label=label)
        if self.y is not None:
            ax.plot(x, self.y[order], color=_TRUTH, linestyle="--", label="observed")
        if self.inducing_points is not None:
            # On the lower edge, whatever the limits: x in data, y in axes units.
            ax.plot(
                self.inducing_points,
                np.full(len(self.inducing_points), 0.03),
                "x",
                color=_INDUCING,
                transform=ax.get_xaxis_transform(),
                label="inducing points",
            )
        self.ax_, self.figure_ = ax, ax.figure
        return self


class CoefficientDisplay:
    """Posterior weights of the explicit features beside their prior, with bars of standard deviations.

    Parameters
    ----------
    names : sequence of str
        Of the weights.
    mean, std, prior_mean, prior_std : ndarray of shape (n_weights,)

    Attributes
    ----------
    ax_ : matplotlib Axes
    figure_ : matplotlib Figure

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
        """Read the weights off a fitted regressor and draw.

        Parameters
        ----------
        estimator : EVGPRegressor
            Fitted, with a feature map.
        output : int, default=0
            Which output's weights to draw.
        ax : matplotlib Axes, default=None
            By default new axes.
        n_std : float, default=2.0
            Half length of the bars, in standard deviations.

        Returns
        -------
        display : CoefficientDisplay

        Raises
        ------
        ValueError
            If the regressor has no explicit features, or there is no such output.
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        check_is_fitted(estimator)
        n_outputs, width = np.atleast_2d(estimator.coef_).shape
        if width == 0:
            raise ValueError("The regressor has no weights to show: it was fitted with feature_map=None.")
        _check_output(output, n_outputs)
        try:
            names = [str(name) for name in estimator.feature_map_.get_feature_names_out()]
        except AttributeError:  # A map, or a step of it, that does not name its features.
            names = [f"h{index}" for index in range(width)]
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
        """Draw.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            By default new axes.
        n_std : float, default=2.0
            Half length of the bars, in standard deviations.

        Returns
        -------
        self : object

        Raises
        ------
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        ax = _axes(ax)
        places = np.arange(len(self.names))[::-1]
        for mean, std, shift, colour, marker, label in (
            (self.prior_mean, self.prior_std, 0.12, "0.55", "s", "prior"),
            (self.mean, self.std, -0.12, _MODEL, "o", "posterior"),
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
        ax.axvline(0.0, color="0.85", linewidth=0.8, zorder=0)
        ax.set_yticks(places, self.names)
        ax.margins(x=0.1)
        ax.set_ylim(-0.6, len(self.names) - 0.4)
        self.ax_, self.figure_ = ax, ax.figure
        return self


# Okabe & Ito's, without black and yellow.
_PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


class LearningCurveDisplay:
    """Test score against the number of training rows: the mean of several runs, in a band from lowest to highest.

    The paper's figure of section IV-B. Curves of several models can share axes.

    Parameters
    ----------
    n_rows : ndarray of shape (n_sizes,)
        Training rows, ascending.
    scores : ndarray of shape (n_sizes, n_runs)
        On test rows; NaN where a run is missing.
    score_name : str, default="prediction error"
        For the vertical axis.

    Attributes
    ----------
    ax_ : matplotlib Axes
    figure_ : matplotlib Figure

    See Also
    --------
    LearningCurveDisplay.from_estimator : Make one by fitting a regressor to more and more rows.
    sklearn.model_selection.LearningCurveDisplay : Scores by cross-validation, without a test set of their own.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_dynamics
    >>> from skevgp.features import InertiaForceGravity
    >>> from skevgp.plotting import LearningCurveDisplay
    >>> train, test = (make_dynamics("pendulum", 4, 50, random_state=seed) for seed in (0, 1))
    >>> display = LearningCurveDisplay.from_estimator(
    ...     EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, tol=1e-3, random_state=0),
    ...     *(train.data, train.target, test.data, test.target),
    ...     sizes=[1, 4],
    ...     groups=train.groups,
    ...     n_runs=2,
    ...     random_state=0,
    ... )
    >>> display.n_rows, display.scores.shape
    (array([ 50., 200.]), (2, 2))
    """

    def __init__(self, n_rows: np.ndarray, scores: np.ndarray, score_name: str = "prediction error"):
        self.n_rows = n_rows
        self.scores = scores
        self.score_name = score_name

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: ArrayLike,
        y: ArrayLike,
        X_test: ArrayLike,
        y_test: ArrayLike,
        *,
        sizes: ArrayLike,
        groups: ArrayLike | None = None,
        n_runs: int = 4,
        score: Callable[[Any, Any], float] = prediction_error,
        random_state: int | np.random.RandomState | None = None,
        ax: Any = None,
        log_scale: bool | None = None,
        label: str | None = None,
        color: str | None = None,
    ) -> Self:
        """Fit clones to more and more of the training rows, test them all on the same rows, and draw.

        Each run puts the groups in a random order of its own and adds them whole, so that the rows of a smaller size
        are among those of a larger one.

        Parameters
        ----------
        estimator : regressor
            Not fitted itself.
        X : array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
        X_test, y_test : array-like
            What every fit is tested on; columns like those of X and y.
        sizes : array-like of shape (n_sizes,)
            Numbers of groups to learn from, from 1 to all of them, ascending.
        groups : array-like of shape (n_samples,), default=None
            The trajectory of each row, as in `make_dynamics`; None is a group per row.
        n_runs : int, default=4
            Orders of the groups, at least 1.
        score : callable, default=prediction_error
            ``score(y_test, y_pred) -> float``.
        random_state : int, RandomState instance or None, default=None
            Draws the orders. What the estimator draws is up to its own ``random_state``.
        ax : matplotlib Axes, default=None
            Where to draw; by default on new axes.
        log_scale : bool, default=None
            As in `plot`.
        label, color : str, default=None
            As in `plot`.

        Returns
        -------
        display : LearningCurveDisplay
            Its ``n_rows`` are means over runs, should groups differ in length.

        Raises
        ------
        ValueError
            If a size is not a possible number of groups, sizes do not ascend, or X, y and groups differ in length.
        TypeError
            If a size or n_runs is not an integer.
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        require("matplotlib.pyplot", "Plotting")  # before the fits, not after them
        check_consistent_length(X, y, groups)
        groups = np.arange(_num_samples(X)) if groups is None else groups
        labels, group_of_row = np.unique(groups, return_inverse=True)
        steps = np.ravel(sizes).tolist()
        for index, size in enumerate(steps):
            check_integer(size, f"sizes[{index}]", minimum=1)
        if not steps or min(np.diff(steps), default=1) < 1 or steps[-1] > len(labels):
            raise ValueError(f"sizes={steps} must ascend, from at least 1 to at most the {len(labels)} groups.")
        check_integer(n_runs, "n_runs", minimum=1)
        rng = check_random_state(random_state)
        n_rows, scores = np.empty((2, len(steps), n_runs))
        for run in range(n_runs):
            place_of_row = rng.permutation(len(labels))[group_of_row]
            for index, size in enumerate(steps):
                rows = np.flatnonzero(place_of_row < size)
                fitted = clone(estimator).fit(_safe_indexing(X, rows), _safe_indexing(y, rows))
                n_rows[index, run], scores[index, run] = len(rows), score(y_test, fitted.predict(X_test))
        name = getattr(score, "__name__", "score").replace("_", " ")
        return cls(n_rows.mean(axis=1), scores, name).plot(ax, log_scale=log_scale, label=label, color=color)

    def plot(
        self, ax: Any = None, *, log_scale: bool | None = None, label: str | None = None, color: str | None = None
    ) -> Self:
        """Draw.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            By default new axes.
        log_scale : bool, default=None
            Whether both axes are logarithmic; None makes them so if all scores are positive.
        label : str, default=None
            Name of the line, for ``display.ax_.legend()``.
        color : str, default=None
            By default the first of a colour-blind-safe palette that is not yet on the axes.

        Returns
        -------
        self : object

        Raises
        ------
        ValueError
            If ``log_scale=True`` and a score is not positive.
        ImportError
            If matplotlib is not installed; the message gives the pip command.
        """
        positive = bool(np.nanmin(self.scores) > 0)
        if log_scale and not positive:
            raise ValueError(f"log_scale=True needs positive scores; the smallest is {np.nanmin(self.scores)}.")
        ax = _axes(ax)
        if color is None:
            used = {line.get_color() for line in ax.lines}
            color = next((free for free in _PALETTE if free not in used), _PALETTE[0])
        low, high = np.nanmin(self.scores, axis=1), np.nanmax(self.scores, axis=1)
        ax.fill_between(self.n_rows, low, high, color=color, alpha=0.2, linewidth=0)
        ax.plot(self.n_rows, np.nanmean(self.scores, axis=1), ".-", color=color, label=label)
        if positive if log_scale is None else log_scale:
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xticks(self.n_rows, [f"{count:g}" for count in self.n_rows])
            ax.set_xticks([], minor=True)
        ax.set_xlabel("training rows")
        ax.set_ylabel(self.score_name)
        self.ax_, self.figure_ = ax, ax.figure
        return self

"""LearningCurveDisplay: test score against the number of training rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_consistent_length, has_fit_parameter

from ..metrics import prediction_error
from ..utils.optional import require
from ..utils.sklearn import num_samples, safe_indexing
from ..utils.validation import check_integer
from ._style import axes_of, free_color


class LearningCurveDisplay:
    """Test score against the number of training rows, as in Figure 6 of the paper.

    The plot shows the mean and the range of several runs. Curves of several models can share axes.

    Parameters
    ----------
    n_rows : ndarray of shape (n_sizes,)
        Numbers of training rows, ascending.
    scores : ndarray of shape (n_sizes, n_runs)
        Scores on test rows. They are NaN if a run is missing.
    score_name : str, default="prediction error"
        Label of the vertical axis.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    LearningCurveDisplay.from_estimator : Make one by fits to increasing numbers of rows.
    sklearn.model_selection.LearningCurveDisplay : Scores by cross-validation, without a test set.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_dynamics
    >>> from skevgp.features import InertiaForceGravity
    >>> from skevgp.plotting import LearningCurveDisplay
    >>> train, test = (make_dynamics("pendulum", 4, 10, random_state=seed) for seed in (0, 1))
    >>> display = LearningCurveDisplay.from_estimator(
    ...     EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=5, sharing="all", random_state=0),
    ...     *(train.data, train.target, test.data, test.target),
    ...     sizes=[1, 4],
    ...     groups=train.groups,
    ...     n_runs=2,
    ...     random_state=0,
    ... )
    >>> display.n_rows, display.scores.shape
    (array([10., 40.]), (2, 2))
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
        """Fit clones to increasing numbers of training rows, test them on the same rows, and draw.

        Each run adds whole groups in its own random order, so that larger training sets contain the smaller ones.

        Parameters
        ----------
        estimator : regressor
            Regressor, of which clones are fitted.
        X : array-like of shape (n_samples, n_features)
            All training rows.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets of the training rows.
        X_test, y_test : array-like
            Test rows, with the columns of X and y.
        sizes : array-like of shape (n_sizes,)
            Numbers of groups in the training sets, ascending, from 1 to all groups.
        groups : array-like of shape (n_samples,), default=None
            Labels of the trajectory of each row, as in `make_dynamics`. ``fit`` gets them too, if it takes groups. If
            None, each row is a group.
        n_runs : int, default=4
            Number of random orders of the groups, at least 1.
        score : callable, default=prediction_error
            Function ``score(y_test, y_pred) -> float``.
        random_state : int, RandomState instance or None, default=None
            Seed of the orders. The estimator keeps its own ``random_state``.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        log_scale : bool, default=None
            Whether both axes are logarithmic, as in `plot`.
        label, color : str, default=None
            Name and colour of the line, as in `plot`.

        Returns
        -------
        display : LearningCurveDisplay
            The drawn display. Its ``n_rows`` are means over runs.

        Raises
        ------
        ValueError
            If a size is not a possible number of groups, sizes do not ascend, or X, y and groups differ in length.
        TypeError
            If a size or n_runs is not an integer.
        """
        require("matplotlib.pyplot", "Plotting")  # raises the error before the fits
        check_consistent_length(X, y, groups)
        told = groups is not None and has_fit_parameter(estimator, "groups")
        groups = np.arange(num_samples(X)) if groups is None else groups
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
                known = {"groups": group_of_row[rows]} if told else {}
                fitted = clone(estimator).fit(safe_indexing(X, rows), safe_indexing(y, rows), **known)
                n_rows[index, run], scores[index, run] = len(rows), score(y_test, fitted.predict(X_test))
        name = getattr(score, "__name__", "score").replace("_", " ")
        return cls(n_rows.mean(axis=1), scores, name).plot(ax, log_scale=log_scale, label=label, color=color)

    def plot(
        self, ax: Any = None, *, log_scale: bool | None = None, label: str | None = None, color: str | None = None
    ) -> Self:
        """Draw the display.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.
        log_scale : bool, default=None
            Whether both axes are logarithmic. If None, this is the case if all scores are positive.
        label : str, default=None
            Name of the line, for ``display.ax_.legend()``.
        color : str, default=None
            Colour. If None, the first colour of a colour-blind-safe palette that is not on the axes yet.

        Returns
        -------
        self : LearningCurveDisplay
            The display itself, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError
            If ``log_scale=True`` and a score is not positive.
        """
        positive = bool(np.nanmin(self.scores) > 0)
        if log_scale and not positive:
            raise ValueError(f"log_scale=True needs positive scores; the smallest is {np.nanmin(self.scores)}.")
        ax = axes_of(ax)
        color = free_color(ax) if color is None else color
        low, high = np.nanmin(self.scores, axis=1), np.nanmax(self.scores, axis=1)
        ax.fill_between(self.n_rows, low, high, color=color, alpha=0.2, linewidth=0)
        ax.plot(self.n_rows, np.nanmean(self.scores, axis=1), ".-", color=color, label=label)
        if positive if log_scale is None else log_scale:
            # Ticks of curves that are on the axes already, which a change of the scale removes.
            counts = np.union1d(getattr(ax.xaxis.get_major_locator(), "locs", []), self.n_rows)
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xticks(counts, [f"{count:g}" for count in counts])
            ax.set_xticks([], minor=True)
        ax.set_xlabel("training rows")
        ax.set_ylabel(self.score_name)
        self.ax_, self.figure_ = ax, ax.figure
        return self

"""FeatureReportDisplay: what a model loses without each group of its explicit features."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ._style import BLUE, axes_of

if TYPE_CHECKING:
    from ..estimators.report import FeatureReport


class FeatureReportDisplay:
    """Loss of held-out log density without each group of features, with error bars of two standard errors.

    Parameters
    ----------
    names : sequence of str
        Names of the groups.
    losses, errors : ndarray of shape (n_groups,)
        Losses in nats per row, and their standard errors. Groups above 0 help.
    verdicts : sequence of str
        Verdict on each group.

    Attributes
    ----------
    ax_ : matplotlib Axes
        Axes of the plot.
    figure_ : matplotlib Figure
        Figure of the plot.

    See Also
    --------
    FeatureReportDisplay.from_report : Make one from a report.
    skevgp.feature_report : Compute a report.

    Examples
    --------
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import EVGPRegressor, feature_report
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.plotting import FeatureReportDisplay
    >>> X, y = make_toy(60, random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(PolynomialFeatures(1), n_inducing=5, random_state=0).fit(X, y)
    >>> FeatureReportDisplay.from_report(feature_report(model, X, y, n_splits=2)).names
    ['features', 'all features']
    """

    def __init__(self, names: list[str], losses: np.ndarray, errors: np.ndarray, verdicts: list[str]):
        self.names = names
        self.losses = losses
        self.errors = errors
        self.verdicts = verdicts

    @classmethod
    def from_report(cls, report: FeatureReport, *, ax: Any = None) -> Self:
        """Take the losses from a report, and draw.

        Parameters
        ----------
        report : FeatureReport
            Report on held-out rows.
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.

        Returns
        -------
        display : FeatureReportDisplay
            The drawn display, with ``ax_`` and ``figure_``.

        Raises
        ------
        ValueError
            If the report was made without X and y.
        """
        if not report.held_out:
            raise ValueError("The report has no held-out rows: pass X and y to feature_report.")
        names, verdicts = ([getattr(one, part) for one in report.groups] for part in ("group", "verdict"))
        losses, errors = (
            np.array([getattr(one, part) for one in report.groups]) for part in ("held_out_loss", "held_out_error")
        )
        return cls(names, losses, errors, verdicts).plot(ax=ax)

    def plot(self, ax: Any = None) -> Self:
        """Draw the display.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. If None, new axes.

        Returns
        -------
        self : FeatureReportDisplay
            The display itself, with ``ax_`` and ``figure_``.
        """
        ax = axes_of(ax)
        places = np.arange(len(self.names))[::-1]
        ax.errorbar(self.losses, places, xerr=2.0 * self.errors, fmt="o", color=BLUE, capsize=3)
        for place, verdict in zip(places, self.verdicts, strict=True):
            ax.text(1.02, place, verdict, transform=ax.get_yaxis_transform(), va="center", color=BLUE)
        ax.axvline(0.0, color="0.85", linewidth=0.8, zorder=0)
        ax.set_yticks(places, self.names)
        ax.margins(x=0.1)
        ax.set_ylim(-0.6, len(self.names) - 0.4)
        ax.set_xlabel("loss without the group, nats per held-out row")
        self.ax_, self.figure_ = ax, ax.figure
        return self

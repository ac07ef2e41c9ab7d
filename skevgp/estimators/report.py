"""`feature_report`: whether explicit features help, group by group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import ArrayLike
from scipy.stats import norm, t, wilcoxon
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, KFold
from sklearn.utils import check_consistent_length, check_random_state

from ..exceptions import ignored
from ..fitting.prior import CoefPrior
from ..fitting.theta import restricted
from ..model.predictor import CoefficientPrior
from ..noise import as_noise
from ..utils.optional import require
from ..utils.sklearn import safe_indexing
from ..utils.validation import check_fitted, check_integer, checked_groups
from .base import GaussianProcess
from .summary import html_table

# The last line of a report, in which all features are left out.
EVERYTHING = "all features"
# A difference of log densities below this, in nats per row, does not matter.
_LEAST = 0.01
# Degrees of freedom of Student's t, by which rows count if the noise has outliers.
_FREEDOM = 4.0
# Probability of a difference by chance below which it counts, in Wilcoxon's signed-rank test.
_CHANCE = 0.05


class FeatureGroup(NamedTuple):
    """What a report says of one group of weights."""

    group: str
    # Number of weights, of all outputs.
    n_weights: int
    # Learned standard deviation of the prior, over that of the feature map: geometric mean over outputs.
    scale_factor: float
    # Root mean square distance of the weights from their prior mean, in prior standard deviations.
    moved: float
    # Posterior over prior standard deviation: root mean square. Near 0 if the data determine the weights.
    std_ratio: float
    # Without the group: fall of the bound of training rows, and of the log density of held-out rows, in nats per row,
    # with the standard error of the latter. NaN without data.
    bound_loss: float = np.nan
    held_out_loss: float = np.nan
    held_out_error: float = np.nan
    # The verdict: "helps", "does nothing", "hurts", "unclear", or "unknown" without data.
    verdict: str = "unknown"

    def __str__(self) -> str:
        """Return the verdict as a sentence."""
        if self.verdict == "unknown":
            return f"{self.group}: pass X and y to see whether the features help."
        change = "falls" if self.held_out_loss > 0.0 else "rises"
        said = "effect unclear" if self.verdict == "unclear" else self.verdict
        return (
            f"{self.group}: {said}. Without it, the log density of a held-out row {change} by "
            f"{abs(self.held_out_loss):.3g} ± {self.held_out_error:.2g} nats."
        )


@dataclass(frozen=True)
class FeatureReport:
    """Report on whether explicit features help, as returned by `feature_report`.

    ``print`` shows it as text, and a notebook as a table.

    Parameters
    ----------
    groups : tuple of FeatureGroup
        An entry for each group of weights, and one for all features together.
    held_out : str
        Kind of the held-out data: "trajectories", "rows" or "" (none).

    See Also
    --------
    feature_report : Compute a report.

    Examples
    --------
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import EVGPRegressor, feature_report
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(60, random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(PolynomialFeatures(1), n_inducing=10, random_state=0).fit(X, y)
    >>> print(feature_report(model).groups[0])
    features: pass X and y to see whether the features help.
    """

    groups: tuple[FeatureGroup, ...]
    held_out: str

    def to_frame(self) -> Any:
        """Return the numbers as a pandas.DataFrame.

        Returns
        -------
        frame : pandas.DataFrame
            A row for each group, with the columns of `FeatureGroup`.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        pandas = require("pandas", "A data frame")
        return pandas.DataFrame([list(one) for one in self.groups], columns=list(FeatureGroup._fields))

    def __str__(self) -> str:
        """Return a table and the verdicts."""
        table = self._table()
        widths = [max(len(line[column]) for line in table) for column in range(len(table[0]))]
        lines = [
            "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)).rstrip() for line in table
        ]
        return "\n".join([*lines, "", *map(str, self.groups)])

    def _repr_html_(self) -> str:
        """Return the same as HTML, with all names escaped."""
        header, *lines = self._table()
        return html_table(lines, header) + html_table([[str(one)] for one in self.groups])

    def _table(self) -> list[list[str]]:
        lines = [["group", "weights", "prior scale", "moved", "posterior / prior std", "bound loss", "held-out loss"]]
        for one in self.groups:
            losses = ["", ""]
            if self.held_out:
                losses = [f"{one.bound_loss:.3g}", f"{one.held_out_loss:.3g} ± {one.held_out_error:.2g}"]
            numbers = [f"{value:.2g}" for value in (one.moved, one.std_ratio)]
            lines.append([one.group, str(one.n_weights), f"× {one.scale_factor:.2g}", *numbers, *losses])
        return lines


def feature_report(
    model: GaussianProcess,
    X: Any = None,
    y: ArrayLike | None = None,
    *,
    groups: ArrayLike | None = None,
    n_splits: int = 3,
    n_jobs: int | None = None,
    random_state: int | np.random.RandomState | None = 0,
) -> FeatureReport:
    """Report whether the explicit features of a model help, for each group of weights.

    With X and y, the model is fitted again without each group, and predicts held-out rows. Each fit has its own kernel,
    noise and inducing points. Thus the Gaussian process can replace the features that are left out.

    Parameters
    ----------
    model : EVGPRegressor or EGPRegressor
        Fitted regressor with a ``feature_map``.
    X : array-like of shape (n_samples, n_features), default=None
        Rows to fit and to hold out, for example the training data. If None, the report has priors and posteriors only.
    y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
        Targets.
    groups : array-like of shape (n_samples,), default=None
        Labels of the trajectory of each row. Whole trajectories are then held out. If None, rows are independent.
    n_splits : int, default=3
        Number of folds. Each fold has a fit for each group, and one for the whole model.
    n_jobs : int, default=None
        Number of fits in parallel processes. If None, 1; if -1, all cores.
    random_state : int, RandomState instance or None, default=0
        Seed of the folds of rows without ``groups``.

    Returns
    -------
    report : FeatureReport
        The numbers of each group. ``print(report)`` shows a table and a sentence for each group.

    Raises
    ------
    NotFittedError
        If the model is not fitted.
    TypeError
        If the model is another regressor.
    ValueError
        If the model has no features, or there are fewer groups than folds.

    See Also
    --------
    CoefPrior : Groups of weights and their prior.
    skevgp.plotting.FeatureReportDisplay : Draw the report.

    Notes
    -----
    A feature that is left out has the weight 0. Weights without a label are in the group "features".

    The loss of a group is the log density per held-out row with the group, minus that without it. It is summed over
    outputs and averaged over trajectories, or over rows without ``groups``.

    A group helps or hurts if Wilcoxon's signed-rank test of its losses is significant at the level 0.05. The test needs
    at least six trajectories. Also, the mean loss must exceed 0.01 nats in size and have the sign of the median.
    Otherwise, the group does nothing if the mean loss plus or minus two standard errors is within 0.05 nats of 0. In
    all other cases the verdict is "unclear".

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.preprocessing import FunctionTransformer
    >>> from skevgp import EVGPRegressor, feature_report
    >>> angle = np.linspace(0.0, 30.0, 80)[:, np.newaxis]
    >>> torque = 5.0 * np.sin(angle[:, 0]) + 0.1 * np.random.default_rng(0).standard_normal(80)
    >>> turns = np.arange(80) // 10  # each ten rows are a trajectory
    >>> gravity = FunctionTransformer(np.sin)
    >>> model = EVGPRegressor(gravity, n_inducing=5, random_state=0).fit(angle, torque, groups=turns)
    >>> report = feature_report(model, angle, torque, groups=turns, n_splits=2)
    >>> {one.group: one.verdict for one in report.groups}
    {'features': 'helps', 'all features': 'helps'}
    """
    check_fitted(model)
    if not isinstance(model, GaussianProcess):
        raise TypeError(f"feature_report needs an EVGPRegressor or EGPRegressor; got {model!r}.")
    if not hasattr(model, "coef_"):
        raise ValueError("The model has no features: it was fitted with feature_map=None.")
    check_integer(n_splits, "n_splits", minimum=2)
    prior = _prior_of(model).outputs(slice(0, 1) if model._posterior.predictor.shared else slice(None))
    labels = np.atleast_2d(model.coef_groups_)
    labels = np.where(labels == "", "features", labels)
    # A weight that cannot move is no part of a group, unless all are left out.
    labels = np.where(prior.scale > 0.0, labels, "")
    masks = {name: labels == name for name in dict.fromkeys(labels.ravel()) if name}
    masks[EVERYTHING] = np.ones(labels.shape, dtype=bool)
    found = [_of_weights(model, name, mask) for name, mask in masks.items()]
    if X is None:
        return FeatureReport(tuple(found), "")
    if y is None:
        raise ValueError("feature_report needs y with X.")
    check_consistent_length(X, y)
    target = np.asarray(y)
    trajectories = checked_groups(groups, len(target))
    if trajectories is None:
        splits = list(KFold(n_splits, shuffle=True, random_state=check_random_state(random_state)).split(target))
    else:
        n_groups = len(np.unique(trajectories))
        if n_groups < n_splits:
            raise ValueError(
                f"n_splits={n_splits} needs at least {n_splits} groups; got {n_groups}. If the rows are one recording, "
                "cut it into blocks of a few seconds, and pass these as groups."
            )
        splits = list(GroupKFold(n_splits).split(target, groups=trajectories))
    # The whole model first.
    nothing = np.zeros(labels.shape, dtype=bool)
    models = [_without(model, prior, mask) for mask in (nothing, *masks.values())]
    jobs = [(one, split) for one in models for split in splits]
    results = Parallel(n_jobs)(delayed(_held_out)(one, X, target, trajectories, split) for one, split in jobs)
    of_models = [results[start:][: len(splits)] for start in range(0, len(results), len(splits))]
    bounds = [np.mean([bound for bound, _ in own]) for own in of_models]
    densities = [np.concatenate([density for _, density in own]) for own in of_models]
    for i in range(len(found)):
        losses = densities[0] - densities[1 + i]
        loss, error = float(losses.mean()), float(losses.std(ddof=1) / np.sqrt(len(losses)))
        found[i] = found[i]._replace(
            bound_loss=float(bounds[0] - bounds[1 + i]),
            held_out_loss=loss,
            held_out_error=error,
            verdict=_verdict(losses, loss, error),
        )
    return FeatureReport(tuple(found), "rows" if trajectories is None else "trajectories")


def _prior_of(model: Any) -> CoefficientPrior:
    """The prior of the weights of features, before its scales were learned."""
    return restricted(model._fitted.units.prior, model.coef_.shape[-1])


def _verdict(losses: np.ndarray, loss: float, error: float) -> str:
    """Return what held-out losses (n,), their mean and its standard error say of a group."""
    middle = float(np.median(losses))
    # A few rows may outweigh all others.
    if abs(loss) > _LEAST and middle * loss > 0.0 and wilcoxon(losses).pvalue < _CHANCE:
        return "helps" if loss > 0.0 else "hurts"
    return "does nothing" if abs(loss) + 2.0 * error < 5.0 * _LEAST else "unclear"


def _of_weights(model: Any, name: str, mask: np.ndarray) -> FeatureGroup:
    """What the fit says of a group of weights."""
    mean, std, prior_mean, prior_std = (
        np.atleast_2d(values)[mask]
        for values in (model.coef_, model.coef_std_, model.coef_prior_mean_, model.coef_prior_scale_)
    )
    given = _prior_of(model).scale[: len(mask)][mask]
    free = (prior_std > 0.0) & np.isfinite(prior_std)
    if not free.any():
        # Weights that are fixed, or have no prior.
        ratio = 0.0 if np.isinf(prior_std).any() else 1.0
        return FeatureGroup(name, int(mask.sum()), 1.0, np.nan, ratio)
    mean, std, prior_mean, prior_std, given = (own[free] for own in (mean, std, prior_mean, prior_std, given))
    return FeatureGroup(
        name,
        int(mask.sum()),
        float(np.exp(np.mean(np.log(prior_std / given)))),
        float(np.sqrt(np.mean(((mean - prior_mean) / prior_std) ** 2))),
        float(np.sqrt(np.mean((std / prior_std) ** 2))),
    )


def _without(model: Any, prior: Any, out: np.ndarray) -> Any:
    """An unfitted copy of a model in which some weights are 0."""
    first = 0 if prior.shared else slice(None)
    groups = None if prior.groups is None else model.coef_groups_
    scale = np.where(np.isinf(np.atleast_2d(model.coef_prior_scale_)), np.inf, prior.scale)
    mean, scale = np.where(out, 0.0, prior.mean)[first], np.where(out, 0.0, scale)[first]
    if prior.root is None:
        own = CoefPrior(mean, scale, shared=prior.shared, groups=groups)
    else:
        kept = np.where(out[:, :, np.newaxis], 0.0, prior.root)
        own = CoefPrior(mean, cov=(kept @ kept.transpose(0, 2, 1))[first], shared=prior.shared, groups=groups)
    quiet: dict[str, Any] = {"verbose": 0}
    if hasattr(getattr(model, "solver", None), "callback"):
        quiet["solver__callback"] = None
    return clone(model).set_params(coef_prior=own, **quiet)


def _held_out(
    model: Any, X: Any, y: np.ndarray, labels: np.ndarray | None, split: tuple[np.ndarray, np.ndarray]
) -> tuple[float, np.ndarray]:
    """The bound per training row, and the mean log density per row of each held-out trajectory, or of each row."""
    train, test = split
    options: dict[str, Any] = {}
    if labels is not None and hasattr(model, "noise_cv"):
        options["groups"] = labels[train]
    with ignored():
        model.fit(safe_indexing(X, train), y[train], **options)
        mean, std = model.predict(safe_indexing(X, test), return_std=True)
    bound = getattr(model, "lower_bound_", None)
    bound = model.log_marginal_likelihood_value_ if bound is None else bound
    # std is that of rows that are no outliers.
    outliers = as_noise(model.noise).heavy_tails
    each = (
        t.logpdf(y[test].reshape(mean.shape), _FREEDOM, mean, std)
        if outliers
        else norm.logpdf(y[test].reshape(mean.shape), mean, std)
    )
    density = each.reshape(len(test), -1).sum(axis=1)
    if labels is not None:
        density = np.array([density[labels[test] == label].mean() for label in np.unique(labels[test])])
    return bound / len(train), density

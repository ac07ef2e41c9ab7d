"""Scorers of a mean with its standard deviation, for cross-validation."""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, signature
from typing import Any

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import MaxAbsScaler, MinMaxScaler, RobustScaler, StandardScaler

Metric = Callable[..., float]
# These scale and shift each column, which turns a Gaussian into a Gaussian.
_SCALERS = (MaxAbsScaler, MinMaxScaler, RobustScaler, StandardScaler)


class StdScorer:
    """Scorer of the predicted mean and standard deviation, made by `make_std_scorer`."""

    def __init__(self, metric: Metric, sign: int, options: dict[str, Any]):
        self.metric = metric
        self.sign = sign  # 1, or -1 if lower is better
        self.options = options

    def __call__(self, estimator: Any, X: Any, y: Any) -> float:
        """Return the score; higher is better."""
        mean, std = mean_and_std(estimator, X)
        return self.sign * self.metric(y, mean, std, **self.options)

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        name = getattr(self.metric, "__name__", repr(self.metric))
        return f"make_std_scorer({name}{'' if self.sign > 0 else ', greater_is_better=False'}{options})"


def make_std_scorer(score_func: Metric, *, greater_is_better: bool = True, **kwargs: Any) -> StdScorer:
    """Make a scorer from a metric of the predicted mean and standard deviation.

    Pass the scorer as ``scoring`` to `cross_validate`, `GridSearchCV` or `permutation_importance`. For metrics of the
    mean, use `sklearn.metrics.make_scorer`. The scorers of `skevgp.metrics`, such as `neg_nlpd`, are ready to use.

    Parameters
    ----------
    score_func : callable
        Metric ``score_func(y_true, y_pred, std, **kwargs) -> float``, such as `crps`.
    greater_is_better : bool, default=True
        Whether a high number is good. If False, the scorer returns minus the number.
    **kwargs : dict
        Arguments for ``score_func``.

    Returns
    -------
    scorer : callable
        Function ``scorer(estimator, X, y) -> float`` for estimators whose ``predict`` has ``return_std``. It raises a
        TypeError if there is no standard deviation of y.

    Raises
    ------
    TypeError
        If ``score_func`` is not callable.

    Notes
    -----
    The estimator may be the last step of a Pipeline, or inside a search or a MultiOutputRegressor. It may also be
    inside a TransformedTargetRegressor with one of scikit-learn's scalers. Other transformations of y, such as the
    logarithm, do not give a Gaussian of y. A RegressorChain passes on means only. The std of a GaussianProcessRegressor
    has the noise of a WhiteKernel, but not ``alpha``.

    Examples
    --------
    >>> from sklearn.model_selection import cross_validate
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.metrics import containing_ratios, make_std_scorer, neg_crps
    >>> within = make_std_scorer(lambda y_true, y_pred, std: containing_ratios(y_true, y_pred, std, k=2)[0])
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, random_state=0)
    >>> found = cross_validate(model, X, y, cv=3, scoring={"crps": neg_crps, "within 2 std": within})
    >>> float(found["test_within 2 std"].mean().round(2))
    0.94
    """
    if not callable(score_func):
        raise TypeError(f"score_func must be callable; got {score_func!r}.")
    return StdScorer(score_func, 1 if greater_is_better else -1, kwargs)


def mean_and_std(estimator: Any, X: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std of a fitted estimator, also inside scikit-learn's wrappers; TypeError if there is no std."""
    if hasattr(estimator, "best_estimator_"):  # of a search
        return mean_and_std(estimator.best_estimator_, X)
    if isinstance(estimator, Pipeline):  # a pipeline passes return_std on only after set_predict_request
        return mean_and_std(estimator[-1], estimator[:-1].transform(X) if len(estimator) > 1 else X)
    if isinstance(estimator, MultiOutputRegressor):
        parts = [mean_and_std(own, X) for own in estimator.estimators_]
        mean, std = (np.column_stack(part) for part in zip(*parts, strict=True))
        return mean, std
    if isinstance(estimator, TransformedTargetRegressor):
        return _scaled_back(estimator, *mean_and_std(estimator.regressor_, X))
    parameters = signature(estimator.predict).parameters
    if "return_std" not in parameters and all(one.kind != Parameter.VAR_KEYWORD for one in parameters.values()):
        raise TypeError(f"{type(estimator).__name__}.predict takes no return_std: there is no standard deviation.")
    try:
        predicted = estimator.predict(X, return_std=True)
    except (TypeError, ValueError) as problem:
        if "return_std" in parameters:
            raise
        raise TypeError(
            f"{type(estimator).__name__}.predict takes no return_std: there is no standard deviation ({problem})."
        ) from problem
    if not isinstance(predicted, tuple) or len(predicted) != 2:
        raise TypeError(f"{type(estimator).__name__}.predict(return_std=True) returns no pair of mean and std.")
    return predicted


def _scaled_back(model: TransformedTargetRegressor, mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std in the units of y."""
    transformer = model.transformer_
    given = transformer.get_params(deep=False)
    identity = "inverse_func" in given and given["func"] is None and given["inverse_func"] is None
    if not (identity or isinstance(transformer, _SCALERS)) or given.get("clip"):
        names = ", ".join(scaler.__name__ for scaler in _SCALERS)
        raise TypeError(
            f"A TransformedTargetRegressor with {transformer!r} has no standard deviation of y. Only scalers keep it "
            f"({names}). EVGPRegressor scales y itself, and normalize_y=True centres it."
        )
    shape, columns = mean.shape, mean.reshape(len(mean), -1)
    unit = transformer.inverse_transform(np.ones((1, columns.shape[1])))
    unit = np.abs(unit - transformer.inverse_transform(np.zeros((1, columns.shape[1]))))
    return transformer.inverse_transform(columns).reshape(shape), std * unit.reshape(shape[1:])

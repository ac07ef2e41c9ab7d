"""Checks of arguments. Errors name the argument, its value and the allowed values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any

import numpy as np
from scipy.sparse import issparse
from sklearn.exceptions import NotFittedError
from sklearn.utils import assert_all_finite, check_array, check_consistent_length
from sklearn.utils.validation import check_is_fitted, validate_data

from .sklearn import safe_indexing

# float32 is not copied as a whole; pieces of it become float64.
FLOATS = (np.float64, np.float32)
LARGEST = 1e100
# Largest number of rows for the short check of `is_plain`.
_FEW_ROWS = 16
# Smallest size of numbers. The square of a noise far below it is not yet rounded to 0.
SMALLEST = 1e-140


def check_integer(value: Any, name: str, *, minimum: int) -> int:
    """Return an integer not below ``minimum``, or raise an error that names it."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer; got {value!r}.")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}; got {value!r}.")
    return int(value)


def check_real(value: Any, name: str, *, minimum: float = -np.inf, strict: bool = False) -> float:
    """Return a finite number not below (``strict``: above) ``minimum``, or raise an error that names it."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number; got {value!r}.")
    number = float(value)
    if not np.isfinite(number) or number < minimum or (strict and number == minimum):
        raise ValueError(f"{name} must be finite and {'above' if strict else 'at least'} {minimum}; got {value!r}.")
    return number


def is_plain(estimator: Any, X: Any) -> bool:
    """Whether X is a small finite array with the columns of fit, which needs no other check in a control loop."""
    return (
        type(X) is np.ndarray
        and X.dtype == np.float64
        and X.ndim == 2
        and 0 < len(X) <= _FEW_ROWS
        and X.shape[1] == estimator.n_features_in_
        and not hasattr(estimator, "feature_names_in_")
        and bool(np.abs(X).max() <= LARGEST)  # False if there is a NaN
    )


def check_fitted(estimator: Any) -> None:
    """Raise NotFittedError before fit, also for estimators that can predict from their prior."""
    if hasattr(estimator, "__sklearn_is_fitted__") and not estimator.__sklearn_is_fitted__():
        raise NotFittedError(f"This {type(estimator).__name__} instance is not fitted yet. Call fit first.")
    check_is_fitted(estimator)


def is_dask(values: Any) -> bool:
    """Whether it is a Dask collection; does not import Dask."""
    return hasattr(values, "__dask_graph__")


def is_frame(values: Any) -> bool:
    """Whether it is a data frame of pandas, polars or (with scikit-learn 1.7 or later) pyarrow."""
    return hasattr(type(values), "columns") and hasattr(type(values), "shape")


def validate_frame(estimator: Any, X: Any, *y: Any, reset: bool) -> np.ndarray:
    """Check names and number of a data frame's columns, not their values; returns y, if given, as floats."""
    if 0 in X.shape:
        raise ValueError(f"X is empty: its shape is {X.shape}.")
    validate_data(estimator, X, *y, reset=reset, skip_check_array=True)
    if not y:
        return np.empty(0)
    _check_kind(y[0], "y")
    target = check_array(as_floats(y[0], "y"), ensure_2d=False, input_name="y", estimator=estimator)
    check_consistent_length(X, target)
    return target


def validate_numbers(estimator: Any, X: Any, *y: Any, reset: bool, dtype: Any, ensure_min_samples: int = 1) -> Any:
    """Validate rows, and targets of any width as floats, by scikit-learn's `validate_data`; errors name X or y."""
    given = dict(zip(("X", "y"), (X, *y), strict=False))
    for name, values in given.items():
        _check_kind(values, name)
    options: dict[str, Any] = {"reset": reset, "dtype": dtype, "ensure_min_samples": ensure_min_samples}
    if y:
        options |= {"multi_output": True, "y_numeric": True}
    try:
        validated = validate_data(estimator, X, *y, **options)
    except (ValueError, np.exceptions.DTypePromotionError) as error:
        if "could not convert" in str(error) or not isinstance(error, ValueError):
            for name, values in given.items():
                try:
                    np.asarray(values, dtype=np.float64)
                except (TypeError, ValueError) as reason:
                    raise ValueError(f"{name} must be real numbers: {reason}.") from error
        raise
    if not y:
        return validated
    target = validated[1] if validated[1].dtype.kind == "f" else as_floats(validated[1], "y")
    # Objects may have held None, which became NaN.
    assert_all_finite(target, input_name="y", estimator_name=type(estimator).__name__)
    return validated[0], target


def _check_kind(values: Any, name: str) -> None:
    """Raise an error for masked values, dates and times, and a sparse matrix of targets."""
    if name == "y" and issparse(values):
        raise TypeError(f"y must be a dense array; got a sparse matrix of the shape {values.shape}. Use y.toarray().")
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise ValueError(f"{name} must have no masked values. Remove these rows, or impute the values.")
    types = getattr(values, "dtypes", None) if is_frame(values) else [getattr(values, "dtype", None)]
    if types is not None and all(getattr(own, "kind", "") in ("M", "m") for own in types):
        raise ValueError(f"{name} must be real numbers; got dates or times.")


def words_of(frame: Any) -> list[Any]:
    """List the names of the columns of a data frame that are not numbers."""
    names = frame.column_names if hasattr(type(frame), "column_names") else frame.columns  # the first is pyarrow's
    columns = (safe_indexing(frame, index, axis=1) for index in range(frame.shape[1]))
    return [name for name, column in zip(names, columns, strict=True) if not _are_numbers(column)]


def _are_numbers(column: Any) -> bool:
    try:
        array = np.asarray(column)
        array.astype(np.float64)
    except (TypeError, ValueError):
        return False
    return array.dtype.kind not in ("M", "m")


def check_magnitude(values: np.ndarray, name: str, limit: float = LARGEST) -> None:
    """Raise an error for numbers whose squares would overflow."""
    largest = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
    if largest > limit:
        raise ValueError(f"{name} must not exceed {limit:g} in size; its largest value is {largest:g}. Rescale it.")


def check_not_vanishing(largest: np.ndarray, name: str, limit: float = SMALLEST) -> None:
    """Raise an error for columns, other than of zeros, whose squares would vanish, by their largest sizes."""
    if ((largest > 0.0) & (largest < limit)).any():
        smallest = np.min(largest[largest > 0.0])
        raise ValueError(f"{name} must be 0 or exceed {limit:g} in size; a column's largest value is {smallest:g}.")


def check_size(values: np.ndarray, name: str) -> None:
    """Raise an error for columns of numbers (n, columns) whose squares would overflow or vanish."""
    check_magnitude(values, name)
    check_not_vanishing(np.abs(values).max(axis=0), name)


def as_floats(values: Any, name: str) -> np.ndarray:
    """Return real numbers as an array of floats, or raise an error that names them."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "cSUMm":
            return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be real numbers: {error}.") from error
    raise ValueError(f"{name} must be real numbers; got the type {array.dtype}.")


def checked_groups(groups: Any, n_samples: int, name: str = "groups") -> np.ndarray | None:
    """Return numbers 0, 1, ... (n_samples,) for the labels of groups, or None for None."""
    if groups is None:
        return None
    try:
        labels = np.asarray(groups.compute() if is_dask(groups) else groups)
    except ValueError as error:
        raise ValueError(f"{name} must be one label for each row: {error}") from error
    if labels.shape != (n_samples,):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({n_samples},); got {labels.shape}.")
    try:
        numbers: np.ndarray = np.unique(labels, return_inverse=True)[1]
    except TypeError:
        # Labels of several types, such as words and numbers, have no order.
        numbers = np.unique([repr(label) for label in labels.tolist()], return_inverse=True)[1]
    return numbers


@contextmanager
def unchanged_if_it_fails(estimator: Any) -> Iterator[None]:
    """Restore the attributes of an estimator if the code inside fails."""
    before = dict(vars(estimator))
    try:
        yield
    except BaseException:
        estimator.__dict__ = before
        raise

"""How often rows count and how noisy they are, as the user says it: checked, and as the rows take it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..utils.validation import LARGEST, as_floats
from .chosen import Chosen
from .dask import RowWeights, is_dask

_SMALLEST_VARIANCE = 1.0 / LARGEST


def chosen_rows(
    X: Any,
    y: Any,
    sample_weight: Any = None,
    relative_variance: Any = None,
    groups: np.ndarray | None = None,
    ordered: bool = True,
) -> Any:
    """The rows that count.

    Parameters
    ----------
    X : ndarray, data frame or dask.array.Array of shape (n_samples, d)
    y : ndarray or dask.array.Array of shape (n_samples,) or (n_samples, o)
    sample_weight, relative_variance : array-like of shape (n_samples,), optional
        As `EVGPRegressor.fit` takes them.
    groups : ndarray of shape (n_samples,), optional
        Of integers: only rows of the same group are joined.
    ordered : bool, default=True
        Whether few rows are put into an order of their own, and equal ones joined.

    Returns
    -------
    chosen : Chosen
        Of a Dask array: RowWeights.

    Raises
    ------
    ValueError
        If they are not one number for each row, weights are negative or all 0, or variances are not positive.
    """
    if is_dask(X):
        return RowWeights.of(X, sample_weight, relative_variance, check_weights, check_variances)
    counts = _numbers(sample_weight, "sample_weight", len(y))
    variance = _numbers(relative_variance, "relative_variance", len(y))
    if counts is not None:
        check_weights(float(counts.min()), float(counts.max()))
    if variance is not None:
        check_variances(float(variance.min()), float(variance.max()))
    return Chosen.of(X, y, counts, variance, groups) if ordered else Chosen.in_order(len(y), counts, variance)


def check_weights(lowest: float, highest: float) -> None:
    """Refuse weights by the lowest and the highest of them."""
    if not 0.0 <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"sample_weight must be finite, not negative and at most {LARGEST:g}; its entries range from {lowest:g} to "
            f"{highest:g}."
        )
    if highest == 0.0:
        raise ValueError("sample_weight must be above 0 for at least one row; all its entries are zero.")


def check_variances(lowest: float, highest: float) -> None:
    """Refuse relative noise variances by the lowest and the highest of them."""
    if not _SMALLEST_VARIANCE <= lowest <= highest <= LARGEST:
        raise ValueError(
            f"relative_variance must be positive, from {_SMALLEST_VARIANCE:g} to {LARGEST:g}; its entries range from "
            f"{lowest:g} to {highest:g}."
        )


def _numbers(values: Any, name: str, n_samples: int) -> np.ndarray | None:
    if values is None:
        return None
    numbers = as_floats(values.compute() if is_dask(values) else values, name)
    if numbers.shape != (n_samples,):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({n_samples},); got {numbers.shape}.")
    return numbers

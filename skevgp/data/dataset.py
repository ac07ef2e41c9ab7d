"""The user's data set: X and y are validated, rows of positive weight are chosen, and the maps are fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from sklearn.utils.validation import validate_data

from ..utils.validation import (
    FLOATS,
    check_magnitude,
    checked_groups,
    is_dask,
    is_frame,
    validate_frame,
    validate_numbers,
    words_of,
)
from .dask import DaskSource, RowWeights, aligned, dask_example, fit_map_to_chunks
from .maps import MappedRows, Maps, example_of, fit_map
from .rows import LocalSource, Source
from .weights import Chosen


@dataclass(frozen=True)
class Dataset:
    """The rows of a fit."""

    # (n_samples, n_columns): X for the maps, for which a data frame stays one, and X for a kernel without a map.
    given: Any
    X: Any
    # (n_samples,) or (n_samples, n_outputs).
    y: np.ndarray
    # The rows that the fit uses: `Chosen`, or `RowWeights` of Dask arrays.
    chosen: Any
    # The fitted maps.
    maps: Maps
    # The used rows, through the maps.
    source: Source
    # (n_rows,): the group of each row of the source.
    groups: np.ndarray | None = None

    @classmethod
    def from_user(
        cls,
        estimator: Any,
        X: Any,
        y: Any,
        sample_weight: Any = None,
        relative_variance: Any = None,
        groups: Any = None,
    ) -> Dataset:
        """Validate X and y as scikit-learn does, and fit clones of the estimator's maps."""
        given, X, y = checked_rows(estimator, X, y, reset=True)
        groups = checked_groups(groups, len(y))
        chosen = _chosen(X, y, sample_weight, relative_variance, groups)
        fit_to = fit_map_to_chunks if is_dask(X) else partial(fit_map, chosen=chosen)
        feature_map = fit_to(estimator.feature_map, given, y, "feature_map")
        kernel_map = fit_to(estimator.kernel_map, given, y, "kernel_map")
        example = None
        if feature_map is not None or kernel_map is not None:
            example = dask_example(X) if is_dask(X) else example_of(given, chosen)
        maps = Maps(feature_map, kernel_map, example, X.shape[1], getattr(estimator, "feature_names_in_", None))
        source = _source(given, X, y, maps, chosen)
        return cls(given, X, y, chosen, maps, source, None if groups is None else chosen.labels_of(groups))

    def through(self, feature_map: Any) -> Dataset:
        """The same rows through another fitted feature map."""
        maps = replace(self.maps, feature_map=feature_map)
        return replace(self, maps=maps, source=_source(self.given, self.X, self.y, maps, self.chosen))

    @classmethod
    def further(
        cls, estimator: Any, maps: Maps, X: Any, y: Any, sample_weight: Any = None, relative_variance: Any = None
    ) -> Dataset:
        """Further rows for a fitted estimator with these maps."""
        given, X, y = checked_rows(estimator, X, y)
        chosen = _chosen(X, y, sample_weight, relative_variance, ordered=False)
        return cls(given, X, y, chosen, maps, _source(given, X, y, maps, chosen))


def _chosen(
    X: Any, y: Any, sample_weight: Any, relative_variance: Any, groups: np.ndarray | None = None, ordered: bool = True
) -> Any:
    if is_dask(X):
        return RowWeights.of(X, sample_weight, relative_variance)
    return Chosen.of(X, y, sample_weight, relative_variance, groups, ordered)


def _source(given: Any, X: Any, y: np.ndarray, maps: Maps, chosen: Any) -> Source:
    if is_dask(X):
        return DaskSource(X, y, maps, chosen)
    return LocalSource(MappedRows(given, X, y.reshape(len(y), -1), maps, chosen), chosen.n_rows, chosen.positions)


def checked_rows(estimator: Any, X: Any, *y: Any, reset: bool = False) -> tuple[Any, Any, np.ndarray]:
    """Validate X and y. Return X for the maps, X for a kernel without a map, and y as an array. y may be left out.

    A data frame may have columns that are not numbers if there is a ``kernel_map``, since only the maps see it then.
    """
    given = X
    if is_dask(X):
        validate_data(estimator, X, reset=reset, skip_check_array=True)
        X, target = aligned(X, *y) if y else (X, np.empty(0))
        return X, X, target
    if is_frame(X) and (estimator.kernel_map if reset else estimator.kernel_map_) is not None:
        target = validate_frame(estimator, X, *y, reset=reset)
    else:
        X, target = checked_numbers(estimator, X, *y, reset=reset)
    check_magnitude(target, "y")
    return (given if is_frame(given) else X), X, target


def checked_numbers(estimator: Any, X: Any, *y: Any, reset: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Validate X and y as arrays of numbers, for a kernel without a map or for derivatives in X."""
    try:
        validated = validate_numbers(estimator, X, *y, reset=reset, dtype=FLOATS)
    except (ValueError, np.exceptions.DTypePromotionError) as error:
        if is_frame(X) and (words := words_of(X)):
            if (estimator.kernel_map if reset else estimator.kernel_map_) is None:
                reason = (
                    "with kernel_map=None the kernel sees all columns: give a kernel_map that encodes them or "
                    "leaves them out."
                )
            else:
                reason = "derivatives in all columns need them to be."
            raise ValueError(f"The columns {words} of X are not numbers, but {reason}") from error
        raise
    X, target = validated if y else (validated, np.empty(0))
    check_magnitude(X, "X")
    return X, target

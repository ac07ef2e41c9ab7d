"""Dask arrays as data: chunks stay where they are, sums travel; predictions are lazy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from sklearn.utils import check_array

from ..utils.optional import require
from ..utils.validation import as_floats, check_magnitude, is_dask
from .blocks import AnyBlock, Blocks, LinearSums, LocalBlocks
from .maps import EXAMPLE_ROWS, MappedRows, RowShapes, fit_map, fresh_map, spread
from .rows import LocalSource, RawRows, made
from .threads import BlockMap, ordered_sum, single_threaded_libraries
from .weights import Chosen, check_variances, check_weights

# Sums of so many partitions are added up on a worker at a time.
_SUMMED_AT_ONCE = 8
# A map without partial_fit is fitted to so many rows, evenly spread.
_MAP_SAMPLE = 10_000


def _dask() -> Any:
    return require("dask", "Working with Dask arrays")


def _dask_array() -> Any:
    return require("dask.array", "Working with Dask arrays")


def as_rows(values: Any, name: str, ndims: tuple[int, ...] = (2,), known: bool = True) -> Any:
    """A Dask array whose chunks are whole rows, at least one and of known number if so asked, or an error."""
    da = _dask_array()
    if not isinstance(values, da.Array):
        raise TypeError(
            f"{name} must be a Dask array (of a Dask data frame: .to_dask_array(lengths=True)); got {values!r}."
        )
    if values.ndim not in ndims:
        raise ValueError(f"{name} must have {' or '.join(map(str, ndims))} dimensions; got the shape {values.shape}.")
    if values.ndim > 1 and values.numblocks[1] > 1:
        values = values.rechunk({1: -1})
    if known and np.isnan(values.shape[0]):
        values = values.copy().compute_chunk_sizes()  # in place
    if known and 0 in values.shape:
        raise ValueError(f"{name} is empty: its shape is {values.shape}.")
    return values


def aligned(X: Any, y: Any) -> tuple[Any, Any]:
    """X and y as Dask arrays of the same chunks of rows, none of them empty."""
    da = _dask_array()
    X = as_rows(X, "X")
    y = as_rows(y if is_dask(y) else da.from_array(as_floats(y, "y"), chunks="auto"), "y", (1, 2))
    if len(X) != len(y):
        raise ValueError(f"X has {len(X)} rows, but y has {len(y)}.")
    rows = tuple(n for n in X.chunks[0] if n)
    return X.rechunk({0: rows}), y.rechunk({0: rows})


def fit_map_to_chunks(feature_map: Any, X: Any, y: Any, name: str) -> Any:
    """A fitted clone of a transformer, or None: chunk by chunk if it has ``partial_fit``, else to a sample of rows."""
    if feature_map is None:
        return None
    delayed = _dask().delayed
    fitted = fresh_map(feature_map, name)
    if not hasattr(fitted, "partial_fit"):
        chosen = spread(len(X), _MAP_SAMPLE)
        sample_X, sample_y = _dask().compute(X[chosen], y[chosen])
        return fit_map(feature_map, sample_X, sample_y, name)
    fitted = delayed(fitted, traverse=False)
    for X_chunk, y_chunk in zip(X.to_delayed().ravel(), y.to_delayed().ravel(), strict=True):
        fitted = delayed(_partly_fitted)(fitted, X_chunk, y_chunk)
    return fitted.compute()


def dask_example(X: Any) -> np.ndarray:
    """A few of the rows, evenly spread."""
    return np.asarray(X[spread(len(X), EXAMPLE_ROWS)].compute(), dtype=np.float64)


@dataclass(frozen=True)
class RowWeights:
    """How often the rows of Dask arrays count, and how noisy they are.

    Attributes
    ----------
    counts, variance : list of Delayed, optional
        w and v of each chunk.
    kept : ndarray of shape (n_chunks,), optional
        Rows of each chunk that count at all; None: all.
    """

    counts: list[Any] | None = None
    variance: list[Any] | None = None
    kept: np.ndarray | None = None

    @classmethod
    def of(cls, X: Any, counts: Any, variance: Any) -> RowWeights:
        """From arrays (n,), Dask arrays or None; checked by their lowest and highest entries."""
        counts, variance = _chunks_like(X, counts, "sample_weight"), _chunks_like(X, variance, "relative_variance")
        kept = None
        for chunks, check in ((counts, check_weights), (variance, check_variances)):
            if chunks is not None:
                lowest, highest, positive = zip(*_dask().compute(*map(_dask().delayed(_range), chunks)), strict=True)
                check(float(np.min(lowest)), float(np.max(highest)))
                kept = np.array(positive) if chunks is counts else kept
        return cls(counts, variance, kept)

    def labels_of(self, labels: np.ndarray) -> np.ndarray:
        """Of labels (n,) of all rows those of the rows that count."""
        if self.counts is None:
            return labels
        return labels[np.concatenate(_dask().compute(*self.counts)) != 0.0]


def _chunks_like(X: Any, values: Any, name: str) -> list[Any] | None:
    """Numbers of the rows, in the chunks of X."""
    if values is None:
        return None
    values = values if is_dask(values) else _dask_array().from_array(as_floats(values, name), chunks="auto")
    values = as_rows(values, name, (1,))
    if len(values) != len(X):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({len(X)},); got ({len(values)},).")
    return list(values.rechunk({0: X.chunks[0]}).to_delayed().ravel())


class DaskSource:
    """Rows that Dask's workers hold.

    Parameters
    ----------
    X : dask.array.Array of shape (n, n_columns)
    y : dask.array.Array of shape (n,) or (n, o)
        In the same chunks.
    feature_map, kernel_map : transformer or None
        Fitted.
    weights : RowWeights, optional
        Of the chunks; rows of weight 0 are left out.
    shapes : (tuple, tuple), optional
        As of `MappedRows`.
    """

    positions: np.ndarray | None = None

    def __init__(
        self,
        X: Any,
        y: Any,
        feature_map: Any,
        kernel_map: Any,
        weights: RowWeights | None = None,
        shapes: RowShapes | None = None,
    ):
        dask, weights = _dask(), RowWeights() if weights is None else weights
        maps = dask.delayed((feature_map, kernel_map), traverse=False)
        lengths = np.array(X.chunks[0]) if weights.kept is None else weights.kept
        none = [None] * len(lengths)
        given = X.to_delayed().ravel(), y.to_delayed().ravel()
        chunks = zip(*given, weights.counts or none, weights.variance or none, strict=True)
        partition = dask.delayed(_partition)
        self._partitions: Sequence[Any] = _held(
            [partition(*chunk, maps, shapes) for chunk, n in zip(chunks, lengths, strict=True) if n > 0]
        )
        self._ends: np.ndarray = np.cumsum(lengths[lengths > 0])
        self.n_rows = int(lengths.sum())

    def sum(self, function: Callable[[RawRows], Any]) -> Any:
        return _sum_over(self._partitions, function)

    def take(self, rows: np.ndarray) -> RawRows:
        dask = _dask()
        owners = np.searchsorted(self._ends, rows, side="right")
        order = np.argsort(owners, kind="stable")
        parts = []
        for owner in np.unique(owners):
            first = self._ends[owner - 1] if owner else 0
            own = rows[order][owners[order] == owner] - first
            parts.append(dask.delayed(_taken)(self._partitions[owner], own))
        found = dask.compute(*parts)
        back = np.argsort(order)
        return RawRows(*_joined(found))[back]

    def part(self, first: int, end: int) -> DaskSource:
        delayed, part = _dask().delayed, copy(self)
        starts = np.append(0, self._ends[:-1])
        cuts = np.column_stack([np.maximum(first - starts, 0), np.minimum(end, self._ends) - starts]).tolist()
        owners = [owner for owner, (begin, stop) in enumerate(cuts) if begin < stop]
        part._partitions = [delayed(_cut)(self._partitions[owner], *cuts[owner]) for owner in owners]
        part._ends = np.cumsum([cuts[owner][1] - cuts[owner][0] for owner in owners])
        part.n_rows = end - first
        return part

    def some(self, rows: np.ndarray) -> DaskSource:
        delayed, some = _dask().delayed, copy(self)
        starts, owners = np.append(0, self._ends[:-1]), np.searchsorted(self._ends, rows, side="right")
        own = [(owner, rows[owners == owner] - starts[owner]) for owner in np.unique(owners)]
        some._partitions = [delayed(_some)(self._partitions[owner], chosen) for owner, chosen in own]
        some._ends = np.cumsum([len(chosen) for _, chosen in own])
        some.n_rows = len(rows)
        return some

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        return DaskBlocks(self._partitions, make, n_inducing)


class DaskBlocks:
    """Blocks that Dask's workers make of their partitions and keep."""

    def __init__(self, partitions: Sequence[Any], make: Callable[[RawRows], AnyBlock], n_inducing: int):
        dask = _dask()
        shared = dask.delayed(make, traverse=False)
        self._partitions = _held([dask.delayed(_blocks)(part, shared, n_inducing) for part in partitions])

    @cached_property
    def linear(self) -> LinearSums:
        return self.sum(LinearSums.of_block)

    def sum(self, function: Callable[[Any], Any]) -> Any:
        return _sum_over(self._partitions, function)


def _held(parts: list[Any]) -> Sequence[Any]:
    """Kept by the workers of a cluster; without one made anew at each pass, since they might not all fit here."""
    try:
        require("distributed", "Fitting on a cluster").get_client()
    except (ImportError, ValueError):
        return parts
    return _dask().persist(*parts)


def _sum_over(partitions: Sequence[Any], function: Callable[..., Any]) -> Any:
    """One map-reduce round; the order of summation depends on nothing but the number of partitions."""
    delayed = _dask().delayed
    shared = delayed(function, traverse=False)
    sums = [delayed(_partition_sum)(partition, shared) for partition in partitions]
    while len(sums) > 1:
        groups = (sums[first : first + _SUMMED_AT_ONCE] for first in range(0, len(sums), _SUMMED_AT_ONCE))
        sums = [delayed(ordered_sum)(group) for group in groups]
    # Numbers from a worker may lie at odd addresses, where np.vdot crashes with the BLAS of some processors.
    return deepcopy(sums[0].compute())


def predict_chunks(model: Any, X: Any, return_std: bool, include_noise: bool, shape: tuple[int, ...]) -> Any:
    """Mean, or mean and standard deviation, as lazy Dask arrays.

    Parameters
    ----------
    model : estimator
        With ``predict``.
    X : dask.array.Array of shape (n, n_columns)
    return_std, include_noise : bool
    shape : tuple
        () or (o,): of one prediction.
    """
    delayed = _dask().delayed
    # As it is now, whatever is folded into it before the result is computed.
    model = copy(model)
    n_outputs = shape[0] if shape else 1
    width = n_outputs * (1 + return_std)
    both = X.map_blocks(
        _predicted,
        model=delayed(model, traverse=False),
        return_std=return_std,
        include_noise=include_noise,
        width=width,
        chunks=(X.chunks[0], (width,)),
        dtype=np.float64,
        meta=np.empty((0, width)),
    )
    columns = slice(None) if shape else 0
    mean = both[:, :n_outputs][:, columns]
    return (mean, both[:, n_outputs:][:, columns]) if return_std else mean


# --- what runs on the workers ------------------------------------------------------------------------------------


def _partition(
    X: np.ndarray,
    y: np.ndarray,
    counts: np.ndarray | None,
    variance: np.ndarray | None,
    maps: tuple[Any, Any],
    shapes: RowShapes | None,
) -> LocalSource:
    # Partitions are worked on at the same time, and transformers need not be safe for that.
    maps = deepcopy(maps)
    X = check_array(X, dtype=[np.float64, np.float32], input_name="X")
    y = check_array(y, dtype=np.float64, ensure_2d=False, input_name="y").reshape(len(X), -1)
    check_magnitude(X, "X")
    check_magnitude(y, "y")
    chosen = Chosen.in_order(len(X), *(None if each is None else as_floats(each, "") for each in (counts, variance)))
    return LocalSource(MappedRows(X, X, y, *maps, chosen, shapes), chosen.n_rows)


def _range(values: np.ndarray) -> tuple[float, float, int]:
    values = as_floats(values, "sample_weight or relative_variance")
    return float(values.min()), float(values.max()), int(np.count_nonzero(values))


def _cut(partition: LocalSource, first: int, end: int) -> LocalSource:
    return partition.part(first, end)


def _some(partition: LocalSource, rows: np.ndarray) -> LocalSource:
    return partition.some(rows)


def _blocks(partition: LocalSource, make: Callable[[RawRows], AnyBlock], n_inducing: int) -> Blocks:
    return LocalBlocks(partial(made, partition.take, make), partition.n_rows, n_inducing, keep=False)


def _partition_sum(partition: Any, function: Callable[..., Any]) -> Any:
    with single_threaded_libraries():
        return partition.sum(function)


def _taken(partition: LocalSource, rows: np.ndarray) -> tuple[Any, ...]:
    return partition.take(rows).parts


def _joined(found: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Rows of several partitions, part by part; a partition whose rows all count once has no weights."""
    if any(parts[3] is not None for parts in found):
        found = [
            (*parts[:3], *(np.ones(len(parts[0])) if part is None else part for part in parts[3:5])) for parts in found
        ]
    return [None if columns[0] is None else np.concatenate(columns) for columns in zip(*found, strict=True)]


def _partly_fitted(fitted: Any, X: np.ndarray, y: np.ndarray) -> Any:
    return deepcopy(fitted).partial_fit(X, y)


def _predicted(X: np.ndarray, model: Any, return_std: bool, include_noise: bool, width: int) -> np.ndarray:
    if len(X) == 0:
        return np.empty((0, width))
    model = copy(model)
    posterior = model._posterior
    model._posterior = replace(posterior, maps=deepcopy(posterior.maps))
    found = model.predict(X, return_std=return_std, include_noise=include_noise)
    return np.hstack([part.reshape(len(X), -1) for part in (found if return_std else (found,))])

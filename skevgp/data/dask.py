"""Dask arrays as data: workers keep the chunks and return sums over them, and predictions are lazy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from sklearn.utils import check_array

from ..utils.optional import require
from ..utils.validation import as_floats, check_magnitude, is_dask
from .blocks import AnyBlock, Blocks, LinearSums
from .maps import EXAMPLE_ROWS, MappedRows, Maps, evenly_spaced, fit_map, fresh_map
from .rows import LocalSource, RawRows
from .threads import BlockMap, ordered_sum, single_threaded_libraries
from .weights import Chosen, check_variances, check_weights, smallest_variance

# A worker adds the sums of this many partitions at a time.
_SUMMED_AT_ONCE = 8
# A map without partial_fit is fitted to this many evenly spaced rows.
_MAP_SAMPLE = 10_000


def _dask() -> Any:
    return require("dask", "Working with Dask arrays")


def _dask_array() -> Any:
    return require("dask.array", "Working with Dask arrays")


def as_rows(values: Any, name: str, ndims: tuple[int, ...] = (2,), known: bool = True) -> Any:
    """Validate a Dask array and make its chunks whole rows. If ``known``, count the rows, at least one."""
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
    """Validate X and y, and give them the same chunks of rows without empty ones."""
    da = _dask_array()
    X = as_rows(X, "X")
    y = as_rows(y if is_dask(y) else da.from_array(as_floats(y, "y"), chunks="auto"), "y", (1, 2))
    if len(X) != len(y):
        raise ValueError(f"X has {len(X)} rows, but y has {len(y)}.")
    rows = tuple(n for n in X.chunks[0] if n)
    return X.rechunk({0: rows}), y.rechunk({0: rows})


def fit_map_to_chunks(feature_map: Any, X: Any, y: Any, name: str) -> Any:
    """Fit a clone of a transformer, or return None for None. Without ``partial_fit``, it sees a sample of rows."""
    if feature_map is None:
        return None
    delayed = _dask().delayed
    fitted = fresh_map(feature_map, name)
    if not hasattr(fitted, "partial_fit"):
        chosen = evenly_spaced(len(X), _MAP_SAMPLE)
        sample_X, sample_y = _dask().compute(X[chosen], y[chosen])
        return fit_map(feature_map, sample_X, sample_y, name)
    fitted = delayed(fitted, traverse=False)
    for X_chunk, y_chunk in zip(X.to_delayed().ravel(), y.to_delayed().ravel(), strict=True):
        fitted = delayed(_partly_fitted)(fitted, X_chunk, y_chunk)
    return fitted.compute()


def dask_example(X: Any) -> np.ndarray:
    """A few evenly spaced rows."""
    return np.asarray(X[evenly_spaced(len(X), EXAMPLE_ROWS)].compute(), dtype=np.float64)


@dataclass(frozen=True)
class RowWeights:
    """Weights and relative noise variances of the rows of Dask arrays."""

    # w and v of each chunk, as Delayed. None: 1.
    counts: list[Any] | None = None
    variance: list[Any] | None = None
    # (n_chunks,): number of rows of positive weight in each chunk. None: all rows.
    kept: np.ndarray | None = None
    # The smallest relative noise variance that counts, the same for all chunks.
    smallest: float = 0.0

    @classmethod
    def of(cls, X: Any, counts: Any, variance: Any) -> RowWeights:
        """Validate weights and variances (n,): arrays, Dask arrays or None."""
        counts, variance = _chunks_like(X, counts, "sample_weight"), _chunks_like(X, variance, "relative_variance")
        kept = None
        for chunks, check in ((counts, check_weights), (variance, check_variances)):
            if chunks is not None:
                lowest, highest, positive = zip(*_dask().compute(*map(_dask().delayed(_range), chunks)), strict=True)
                check(float(np.min(lowest)), float(np.max(highest)))
                kept = np.array(positive) if chunks is counts else kept
        smallest = 0.0
        if variance is not None:
            pairs = zip(variance, counts or [None] * len(variance), strict=True)
            found = np.array(_dask().compute(*(_dask().delayed(smallest_variance)(*pair) for pair in pairs)))
            # Chunks without a row of positive weight have none.
            smallest = float(np.median(found[found > 0.0])) if found.any() else 0.0
        return cls(counts, variance, kept, smallest)

    def labels_of(self, labels: np.ndarray) -> np.ndarray:
        """The labels of the rows of positive weight, from those of all rows (n,)."""
        if self.counts is None:
            return labels
        return labels[np.concatenate(_dask().compute(*self.counts)) != 0.0]


def _chunks_like(X: Any, values: Any, name: str) -> list[Any] | None:
    """Numbers (n,) as Delayed, in the chunks of X."""
    if values is None:
        return None
    values = values if is_dask(values) else _dask_array().from_array(as_floats(values, name), chunks="auto")
    values = as_rows(values, name, (1,))
    if len(values) != len(X):
        raise ValueError(f"{name} must have the shape (n_samples,) = ({len(X)},); got ({len(values)},).")
    return list(values.rechunk({0: X.chunks[0]}).to_delayed().ravel())


class DaskSource:
    """Rows of Dask arrays X (n, n_columns) and y (n,) or (n, o) with the same chunks. Weights of 0 are left out."""

    positions: np.ndarray | None = None

    def __init__(self, X: Any, y: Any, maps: Maps, weights: RowWeights):
        dask = _dask()
        shared_maps, partition = dask.delayed(maps, traverse=False), dask.delayed(_partition)
        lengths = np.array(X.chunks[0]) if weights.kept is None else weights.kept
        none = [None] * len(lengths)
        given = X.to_delayed().ravel(), y.to_delayed().ravel()
        chunks = zip(*given, weights.counts or none, weights.variance or none, strict=True)
        # Each partition is a `LocalSource` on a worker.
        self._partitions: Sequence[Any] = _held(
            [
                partition(*chunk, shared_maps, weights.smallest)
                for chunk, n in zip(chunks, lengths, strict=True)
                if n > 0
            ]
        )
        self._ends: np.ndarray = np.cumsum(lengths[lengths > 0])
        self.n_rows = int(lengths.sum())

    def sum(self, function: Callable[[RawRows], Any]) -> Any:
        return _sum_over(self._partitions, function)

    def take(self, rows: np.ndarray, /) -> RawRows:
        owners, parts = self._by_partition(rows)
        found = _dask().compute(*(partition.take(own) for partition, own in parts))
        return _joined(found)[np.argsort(np.argsort(owners, kind="stable"))]

    def some(self, rows: np.ndarray) -> DaskSource:
        some, (_, parts) = copy(self), self._by_partition(rows)
        some._partitions = [partition.some(own) for partition, own in parts]
        some._ends = np.cumsum([len(own) for _, own in parts])
        some.n_rows = len(rows)
        return some

    def _by_partition(self, rows: np.ndarray) -> tuple[np.ndarray, list[tuple[Any, np.ndarray]]]:
        """The index of the partition of each row, and the rows of each partition by their index in it."""
        starts, owners = np.append(0, self._ends[:-1]), np.searchsorted(self._ends, rows, side="right")
        return owners, [(self._partitions[owner], rows[owners == owner] - starts[owner]) for owner in np.unique(owners)]

    def blocks(self, make: Callable[[RawRows], AnyBlock], n_inducing: int, threads: BlockMap, share: float) -> Blocks:
        return DaskBlocks(self._partitions, make, n_inducing)


class DaskBlocks:
    """Blocks that Dask's workers make from their partitions and keep."""

    def __init__(self, partitions: Sequence[Any], make: Callable[[RawRows], AnyBlock], n_inducing: int):
        shared = _dask().delayed(make, traverse=False)
        # The two passes over a block may run on different workers. Hence nothing is kept between them.
        self._partitions = _held([part.blocks(shared, n_inducing, keep=False) for part in partitions])

    @cached_property
    def linear(self) -> LinearSums:
        return self.sum(LinearSums.of_block)

    def sum(self, function: Callable[[Any], Any]) -> Any:
        return _sum_over(self._partitions, function)


def _held(parts: list[Any]) -> Sequence[Any]:
    """Let the workers of a cluster keep the parts. Without a cluster, each pass makes them again to save memory."""
    try:
        require("distributed", "Fitting on a cluster").get_client()
    except (ImportError, ValueError):
        return parts
    return _dask().persist(*parts)


def _sum_over(partitions: Sequence[Any], function: Callable[..., Any]) -> Any:
    """One map-reduce round. The order of summation depends on the number of partitions only."""
    delayed = _dask().delayed
    shared = delayed(function, traverse=False)
    sums = [delayed(_partition_sum)(partition, shared) for partition in partitions]
    while len(sums) > 1:
        groups = (sums[first : first + _SUMMED_AT_ONCE] for first in range(0, len(sums), _SUMMED_AT_ONCE))
        sums = [delayed(ordered_sum)(group) for group in groups]
    # Numbers from a worker may have unaligned addresses, where np.vdot crashes with the BLAS of some processors.
    return deepcopy(sums[0].compute())


def predict_chunks(model: Any, X: Any, return_std: bool, include_noise: bool, shape: tuple[int, ...]) -> Any:
    """Mean, or mean and standard deviation, as lazy Dask arrays. A prediction has the shape () or (o,)."""
    delayed = _dask().delayed
    # Predictions are those of the model as it is now, even if it is updated before they are computed.
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


# --- functions that run on the workers --------------------------------------------------------------------------------


def _partition(
    X: np.ndarray,
    y: np.ndarray,
    counts: np.ndarray | None,
    variance: np.ndarray | None,
    maps: Maps,
    smallest: float,
) -> LocalSource:
    # Partitions are processed at the same time, and transformers need not be safe for that.
    maps = deepcopy(maps)
    X = check_array(X, dtype=[np.float64, np.float32], input_name="X")
    y = check_array(y, dtype=np.float64, ensure_2d=False, input_name="y").reshape(len(X), -1)
    check_magnitude(X, "X")
    check_magnitude(y, "y")
    chosen = Chosen.of(X, y, counts, variance, ordered=False, smallest=smallest)
    return LocalSource(MappedRows(X, X, y, maps, chosen), chosen.n_rows)


def _range(values: np.ndarray) -> tuple[float, float, int]:
    values = as_floats(values, "sample_weight or relative_variance")
    return float(values.min()), float(values.max()), int(np.count_nonzero(values))


def _partition_sum(partition: Any, function: Callable[..., Any]) -> Any:
    with single_threaded_libraries():
        return partition.sum(function)


def _joined(parts: Sequence[RawRows]) -> RawRows:
    """Rows of several partitions. A partition in which all weights are 1 has none."""
    if any(part.counts is not None for part in parts):
        ones = [np.ones(len(part.inputs)) for part in parts]
        parts = [
            replace(part, counts=one, precision=one) if part.counts is None else part
            for part, one in zip(parts, ones, strict=True)
        ]
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    joined: list[Any] = [None if each[0] is None else np.concatenate(each) for each in columns]
    return RawRows(*joined)


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

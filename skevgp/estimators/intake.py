"""X and y of a fit, and X of a prediction: validated, through the maps, with the prior of weights and units."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin
from sklearn.gaussian_process.kernels import Kernel
from sklearn.utils.validation import validate_data

from ..data.dask import DaskSource, aligned, dask_example, fit_map_to_chunks
from ..data.maps import MappedRows, RowShapes, check_shapes, example_of, fit_map, map_rows, take_rows
from ..data.rows import LocalSource, Moments, Source, moments_of_rows
from ..data.weights import Chosen, chosen_rows
from ..fitting.coef_prior import resolve_coef_prior, says_shared, wide_scale
from ..fitting.problem import Problem
from ..fitting.units import Units
from ..kernels.parse import KernelSpec, parse_kernel
from ..model.predictor import CoefficientPrior
from ..utils.state import StatefulEstimator
from ..utils.validation import (
    FLOATS,
    check_magnitude,
    check_not_vanishing,
    checked_groups,
    is_dask,
    is_frame,
    validate_frame,
    validate_numbers,
    words_of,
)

# In place of an infinite prior scale, where any that does not matter will do: so many times what could explain y alone.
_VAGUE = 1e3
# Of the largest feature: one that is smaller tells nothing beside it.
_NEGLIGIBLE = 1e-80
# What features may add, in units of what they leave: its square, by the least noise variance, has to be finite.
_LARGEST_SPREAD = 1e130


class Intake(StatefulEstimator):
    """An estimator with explicit features, as far as it takes in rows."""

    feature_map: TransformerMixin | None
    kernel: Kernel | Callable[..., Any] | None
    kernel_map: TransformerMixin | None
    coef_mean: ArrayLike | str
    coef_scale: ArrayLike | str
    coef_cov: ArrayLike | None
    share_coef: bool | Literal["auto"]
    noise_variance: float | None
    normalize_y: bool

    _example: Any
    _spec: KernelSpec
    _row_shapes: RowShapes

    def _problem(
        self,
        X: Any,
        y: Any,
        sample_weight: Any = None,
        relative_variance: Any = None,
        groups: Any = None,
        allow_vague: bool = False,
    ) -> Problem:
        """Look at X, y and the rows' weights for a new fit: maps, kernel, prior and units."""
        given, X, y = self._validated(X, y, reset=True)
        groups = checked_groups(groups, len(y))
        chosen = chosen_rows(X, y, sample_weight, relative_variance, groups)
        fit_to = fit_map_to_chunks if is_dask(X) else partial(fit_map, chosen=chosen)
        self.feature_map_ = fit_to(self.feature_map, given, y, "feature_map")
        self.kernel_map_ = fit_to(self.kernel_map, given, y, "kernel_map")
        self._example = None
        if self.feature_map_ is not None or self.kernel_map_ is not None:
            self._example = dask_example(X) if is_dask(X) else example_of(given, chosen)
        source = self._source(given, X, y, chosen)
        inputs, features, targets = source.sum(moments_of_rows)
        check_not_vanishing(targets.largest, "y")
        check_not_vanishing(inputs.largest, "X, as the kernel sees it,")
        check_not_vanishing(features.largest.max(initial=0.0), "What feature_map returns")
        if isinstance(chosen, Chosen) and chosen.precision is not None:
            root = np.sqrt(chosen.precision.max())
            for largest, name in ((targets.largest, "y"), (features.largest, "what feature_map returns")):
                check_magnitude(root * largest, f"√(sample_weight / relative_variance) times {name}", _LARGEST_SPREAD)
        per_output = inputs.mean.ndim == 2 or features.mean.ndim == 2
        for name, moments in (("kernel_map", inputs), ("feature_map", features)):
            if moments.mean.ndim == 2 and len(moments.mean) != len(targets.mean):
                raise ValueError(
                    f"{name}={getattr(self, name)!r} returns a row for each of {len(moments.mean)} outputs, but y has "
                    f"{len(targets.mean)}."
                )
        n_columns = inputs.mean.shape[-1]
        spec = parse_kernel(self.kernel, n_columns)
        if self.noise_variance is not None:
            if spec.starts.noise.value is not None:
                raise ValueError(
                    f"The noise starts either from noise_variance={self.noise_variance!r} or from the WhiteKernel of "
                    f"kernel={self.kernel!r}; give one of them."
                )
            spec = spec.with_noise(self.noise_variance)
        prior, vague = self._prior(given, features, targets, allow_vague)
        target_mean = targets.mean if self.normalize_y else np.zeros(len(targets.mean))
        units = Units.of(source, features, targets, target_mean, prior)
        with np.errstate(over="ignore"):
            spread = prior.scale * features.largest / units.target_unit[:, np.newaxis]
        check_magnitude(
            spread,
            "the prior standard deviation of coef_ times features, in units of what these leave of y,",
            _LARGEST_SPREAD,
        )
        self._spec, self._row_shapes = spec, (inputs.mean.shape, features.mean.shape)
        groups = None if groups is None else chosen.labels_of(groups)
        return Problem((given, X, y, chosen), source, units, spec, vague, n_columns, per_output, groups)

    def _prior(
        self, given: Any, features: Moments, targets: Moments, allow_vague: bool
    ) -> tuple[CoefficientPrior, np.ndarray]:
        """The weights' prior, in the user's units, and which of them (o, p) are vague."""
        o, shared = len(targets.mean), self.share_coef
        if isinstance(shared, str):
            shared = says_shared(self.feature_map_)
        elif shared and self.feature_map_ is None:
            raise ValueError("share_coef=True needs a feature_map: without one there are no weights to share.")
        shared = shared and o > 1 and self.feature_map_ is not None
        # Bumps far from all rows, say, are as good as 0.
        size = np.where(features.largest > _NEGLIGIBLE * features.largest.max(initial=0.0), features.rms, 0.0)
        wide = wide_scale(size, np.sqrt(targets.variance), targets.largest, shared)
        mean, scale, root = resolve_coef_prior(
            self.coef_mean,
            self.coef_scale,
            self.feature_map_,
            given,
            wide,
            coef_cov=self.coef_cov,
            n_outputs=o,
            allow_vague=allow_vague,
        )
        vague = np.isinf(scale)
        unit = _VAGUE * wide_scale(size, targets.largest, targets.largest, shared)
        scale = np.where(vague, unit, scale)
        if shared:
            mean, scale = (np.repeat(values, o, axis=0) for values in (mean, scale))
            root, vague = None if root is None else np.repeat(root, o, axis=0), np.repeat(vague, o, axis=0)
        return CoefficientPrior(mean, scale, np.zeros(scale.shape), root, shared), vague

    def _validated(self, X: Any, *y: Any, reset: bool = False) -> tuple[Any, Any, np.ndarray]:
        """X as the maps see it (a data frame stays one), X as the kernel sees it without a map, and y as an array.

        A data frame may hold what is no number if there is a ``kernel_map``: then only the maps see it, and what they
        return is checked. To predict, y is left out.
        """
        given = X
        if is_dask(X):
            validate_data(self, X, reset=reset, skip_check_array=True)
            X, target = aligned(X, *y) if y else (X, np.empty(0))
            return X, X, target
        if is_frame(X) and (self.kernel_map if reset else self.kernel_map_) is not None:
            target = validate_frame(self, X, *y, reset=reset)
        else:
            X, target = self._numbers(X, *y, reset=reset)
        check_magnitude(target, "y")
        return (given if is_frame(given) else X), X, target

    def _numbers(self, X: Any, *y: Any, reset: bool) -> tuple[np.ndarray, np.ndarray]:
        """X and y as arrays of numbers: what the kernel sees without a map, and what derivatives are in."""
        try:
            validated = validate_numbers(self, X, *y, reset=reset, dtype=FLOATS)
        except (ValueError, np.exceptions.DTypePromotionError) as error:
            if is_frame(X) and (words := words_of(X)):
                if (self.kernel_map if reset else self.kernel_map_) is None:
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

    def _inputs_and_features(self, given: Any, X: Any, rows: slice | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The kernel's inputs and the features of rows."""
        array = take_rows(X, rows)
        given = array if given is X else take_rows(given, rows)
        inputs, features = map_rows(given, array, self.feature_map_, self.kernel_map_)
        check_shapes((inputs, features), self._row_shapes)
        return inputs, features

    def _source(self, given: Any, X: Any, y: np.ndarray, chosen: Any, shapes: RowShapes | None = None) -> Source:
        """The rows that count, through the maps, which may have to be of certain shapes."""
        maps = self.feature_map_, self.kernel_map_
        if is_dask(X):
            return DaskSource(X, y, *maps, chosen, shapes)
        rows = MappedRows(given, X, y.reshape(len(y), -1), *maps, chosen, shapes)
        return LocalSource(rows, chosen.n_rows, chosen.positions)

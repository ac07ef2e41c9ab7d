"""`Problem`: the description of a fit. An estimator makes it, and `fit_model` reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from ..data.dataset import Dataset
from ..data.maps import RowShapes
from ..data.rows import LocalSource, Moments, Source, moments_of_rows
from ..kernels.parse import KernelSpec, parse_kernel
from ..model.bounds import Variant
from ..model.predictor import CoefficientPrior
from ..noise import Gaussian
from ..noise.base import Noise
from ..solvers import LBFGS, solvers_of_all_rows
from ..solvers.base import Solver
from ..utils.validation import check_magnitude, check_not_vanishing
from .folds import CrossValidation
from .inducing import Placement
from .prior import CoefPrior, InData, coef_names, resolved, says_shared, wide_scale
from .robust import without_far_targets
from .rules import Rules, rules_of
from .units import LeastSquares, Units

# An infinite prior scale becomes this many times the scale of weights without prior knowledge.
_VAGUE = 10.0
# Weights are free with so many rows each. With fewer, a prior of moderate width makes predictions more accurate.
_ENOUGH = 10
# A feature that is smaller than this share of the largest one counts as 0.
_NEGLIGIBLE = 1e-80
# Largest prior standard deviation of the features' contribution, in units of the residuals. Its square over the lowest
# noise variance must be finite.
_LARGEST_SPREAD = 1e130

Sharing = Literal["all", "kernel", "none", "auto"] | Sequence[Sequence[int]]


@dataclass(frozen=True)
class Problem:
    """A fit to be made: the rows, the model, and how its parameters are found."""

    # The rows through both maps, in the user's units.
    source: Source
    # Shift and scale of the targets, and the prior of the weights.
    units: Units
    # The user's choices for kernel and noise.
    spec: KernelSpec
    # (o, p): weights with an infinite prior scale. In ``units.prior`` their scale is very wide.
    vague: np.ndarray
    # Shapes of a row's kernel inputs and of its features.
    shapes: RowShapes
    # Names of the weights, without those of the slopes in parameters θ.
    weight_names: tuple[str, ...] = ()
    # The same rows with far outliers of y moved to the others, for the starts. None: those of ``source``.
    ordinary: Source | None = None
    # (n,): the group of each row of the source.
    groups: np.ndarray | None = None
    # How inducing points are placed.
    placement: Placement = field(default_factory=lambda: Placement("auto", 0))
    solver: Solver = field(default_factory=LBFGS)
    max_iter: int = 0
    # In nats. None: the fit chooses it.
    tol: float | None = None
    sharing: Sharing = "all"
    # Whether ``sharing`` was found by the fit, and not given.
    sharing_found: bool = False
    variant: Variant = field(default_factory=Variant)
    # The folds by which signal and noise are calibrated.
    noise_cv: CrossValidation | None = None
    noise: Noise = field(default_factory=Gaussian)
    # (n, o): noise variances of the rows in units of σ², on top of those in the source. The outputs of a model share
    # their mean.
    row_variance: np.ndarray | None = None
    # Whether predictions are averaged over draws of kernel and noise if rows are few (see `few_rows`).
    averages: bool = True
    # For independent models, or else for blocks of rows.
    n_threads: int = 1

    @classmethod
    def from_data(
        cls,
        data: Dataset,
        *,
        kernel: Any,
        coef_prior: CoefPrior,
        noise: Noise,
        normalize_y: bool,
        allow_vague: bool = False,
    ) -> Problem:
        """Find the kernel's start, the prior of the weights and the internal units from the rows.

        If the noise has heavy tails, they are found without the far outliers of y.

        ``allow_vague`` allows infinite prior scales.
        """
        source = data.source
        if noise.heavy_tails and isinstance(data.source, LocalSource):
            data = replace(data, source=without_far_targets(data.source))
        inputs, features, targets = data.source.sum(moments_of_rows)
        check_not_vanishing(targets.largest, "y")
        check_not_vanishing(inputs.largest, "X, as the kernel sees it,")
        check_not_vanishing(features.largest.max(initial=0.0), "What feature_map returns")
        precision = getattr(data.chosen, "precision", None)
        if precision is not None:
            root = np.sqrt(precision.max())
            for largest, name in ((targets.largest, "y"), (features.largest, "what feature_map returns")):
                check_magnitude(root * largest, f"√(sample_weight / relative_variance) times {name}", _LARGEST_SPREAD)
        for name, moments in (("kernel_map", inputs), ("feature_map", features)):
            if moments.mean.ndim == 2 and len(moments.mean) != len(targets.mean):
                raise ValueError(
                    f"{name}={getattr(data.maps, name)!r} returns a row for each of {len(moments.mean)} outputs, but y "
                    f"has {len(targets.mean)}."
                )
        spec = parse_kernel(kernel, inputs.mean.shape[-1])
        if noise.variance is not None:
            if spec.starts.noise.value is not None:
                raise ValueError(
                    f"The noise starts either from variance={noise.variance!r} of {type(noise).__name__} or from the "
                    f"WhiteKernel of kernel={kernel!r}. Pass one of them only."
                )
            spec = spec.with_noise(noise.variance)
        target_mean = targets.mean if normalize_y else np.zeros(len(targets.mean))
        rows = LeastSquares.of(data.source, target_mean)
        prior, vague = _prior(coef_prior, data, features, targets, rows, allow_vague)
        units = Units.of(data.source, features, targets, rows, prior)
        with np.errstate(over="ignore"):
            spread = prior.scale * features.largest / units.target_unit[:, np.newaxis]
        check_magnitude(
            spread,
            "the prior standard deviation of coef_ times features, in units of what these leave of y,",
            _LARGEST_SPREAD,
        )
        shapes = inputs.mean.shape, features.mean.shape
        ordinary = None if data.source is source else data.source
        names = tuple(coef_names(data.maps.feature_map, data.maps.columns, features.mean.shape[-1]))
        return cls(source, units, spec, vague, shapes, names, ordinary, data.groups, noise=noise)

    def with_features(self, data: Dataset, prior: CoefficientPrior) -> Problem:
        """The same problem with other features of the same rows. ``prior`` is that of their weights."""
        inputs, features, targets = data.source.sum(moments_of_rows)
        rows = LeastSquares.of(data.source, self.units.target_mean)
        units = Units.of(data.source, features, targets, rows, prior)
        vague = np.zeros(prior.scale.shape, dtype=bool)
        vague[:, : self.vague.shape[1]] = self.vague
        shapes = inputs.mean.shape, features.mean.shape
        return replace(self, source=data.source, ordinary=None, units=units, vague=vague, shapes=shapes)

    @property
    def first_source(self) -> Source:
        """The rows for the starts: without far outliers of y if the noise has heavy tails."""
        return self.source if self.ordinary is None else self.ordinary

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.units.target_unit)

    @property
    def n_columns(self) -> int:
        """Number of columns of the kernel's inputs."""
        return self.shapes[0][-1]

    @property
    def may_be_exact(self) -> bool:
        """Whether a fit maximises the likelihood if all rows are inducing points."""
        return not self.noise.heavy_tails and self.rules.lowest_noise_exact is not None

    @property
    def per_output(self) -> bool:
        """Whether each output has its own inputs or features."""
        return max(map(len, self.shapes)) > 1

    @property
    def rules(self) -> Rules:
        """The rules of the search."""
        return rules_of(self.solver)

    def check(self) -> None:
        """Raise a ValueError if the solver or the diagonal posterior cannot fit this problem."""
        solver, prior = self.solver, self.units.prior
        if solver.stochastic and self.per_output and isinstance(self.sharing, str) and self.sharing == "kernel":
            raise ValueError(
                f'sharing="kernel" of outputs with rows of their own needs {solvers_of_all_rows()}; got '
                f"solver={solver!r}."
            )
        if self.variant.orthogonal and (solver.stochastic or self.variant.family == "diagonal"):
            raise ValueError(
                f'discrepancy="orthogonal" needs {solvers_of_all_rows()} with posterior="full"; got solver={solver!r}.'
            )
        asked = "shared=True of CoefPrior" if prior.shared else "a covariance of the weights (cov of CoefPrior)"
        if prior.root is None and not prior.shared:
            return
        if solver.stochastic:
            raise ValueError(f"{asked} needs {solvers_of_all_rows()}; got solver={solver!r}.")
        if self.variant.family == "diagonal":
            raise ValueError(f'{asked} needs posterior="full"; got posterior={self.variant.family!r}.')


def _prior(
    asked: CoefPrior, data: Dataset, features: Moments, targets: Moments, rows: LeastSquares, allow_vague: bool
) -> tuple[CoefficientPrior, np.ndarray]:
    """The prior of the weights in the user's units, and which of them (o, p) are vague."""
    o, shared, feature_map = len(targets.mean), asked.shared, data.maps.feature_map
    if isinstance(shared, str):
        shared = says_shared(feature_map)
    elif shared and feature_map is None:
        raise ValueError("shared=True of CoefPrior needs a feature_map, because its features have the weights.")
    shared = bool(shared) and o > 1 and feature_map is not None
    # A bump far from all rows, for example, counts as 0.
    counts = features.largest > _NEGLIGIBLE * features.largest.max(initial=0.0)
    size = np.where(counts, features.rms, 0.0)

    def left_over(mean: np.ndarray) -> np.ndarray:
        squares = np.sum(rows.left_over(np.broadcast_to(mean, (o, mean.shape[1]))) ** 2, axis=1)
        size = np.sqrt(squares / targets.n)
        return np.where(size > 0.0, size, np.where(targets.largest > 0.0, targets.largest, 1.0))

    few = data.source.n_rows * (o if shared else 1) < _ENOUGH * features.mean.shape[-1]

    @cache
    def wide(learned: bool) -> np.ndarray:
        R = rows.features * counts.reshape(-1, 1, counts.shape[-1])
        if moderate := learned or few:
            y = np.sqrt(targets.variance + (targets.mean - rows.target_mean) ** 2)
        else:
            y = np.maximum(np.abs(targets.lowest - rows.target_mean), np.abs(targets.highest - rows.target_mean))
        return wide_scale(R, targets.n, y, shared, moderate)

    shape = 1 if shared else o, features.mean.shape[-1]
    coefficients = resolved(asked, feature_map, data.given, InData(shape, wide, size, left_over), o, allow_vague)
    mean, scale, root, groups = coefficients.mean, coefficients.scale, coefficients.root, coefficients.groups
    if shared:
        mean, scale, groups = (np.repeat(values, o, axis=0) for values in (mean, scale, groups))
        root = None if root is None else np.repeat(root, o, axis=0)
    vague = np.isinf(scale)
    # An infinite scale becomes one so wide that its value does not matter.
    scale = np.where(vague, _VAGUE * wide(False), scale) if vague.any() else scale
    labels = tuple(dict.fromkeys(label for label in groups.ravel() if label))
    numbers = None
    if labels:
        numbers = np.array([[labels.index(label) if label else -1 for label in row] for row in groups])
    return CoefficientPrior(mean, scale, np.zeros(scale.shape), root, shared, labels, numbers), vague

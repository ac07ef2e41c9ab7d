"""A problem: what is asked of a fit. The estimators make it, and the fit reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ..data.dataset import Dataset
from ..data.maps import RowShapes
from ..data.rows import Moments, Source, moments_of_rows
from ..kernels.parse import KernelSpec, parse_kernel
from ..model.bounds import PosteriorFamily
from ..model.predictor import CoefficientPrior
from ..noise import Gaussian, StudentT
from ..solvers import LBFGS, Adam
from ..utils.validation import check_magnitude, check_not_vanishing
from .calibration import CrossValidation
from .inducing import Placement
from .prior import CoefPrior, resolved, says_shared, wide_scale
from .search import Rules, rules_of
from .units import Units

# For an infinite prior scale: so many times what could explain y alone.
_VAGUE = 1e3
# Of the largest feature: one that is smaller tells nothing next to it.
_NEGLIGIBLE = 1e-80
# What features may add, in units of what they leave: its square, by the least noise variance, has to be finite.
_LARGEST_SPREAD = 1e130

Sharing = Literal["all", "kernel", "none", "auto"] | Sequence[Sequence[int]]


@dataclass(frozen=True)
class Problem:
    """What is asked of a fit: the rows, the model, and how its parameters are found.

    Attributes
    ----------
    source : Source
        The rows through both maps, in the user's units.
    units : Units
        The internal units, and the prior of the weights.
    spec : KernelSpec
        What the user says of kernel and noise.
    vague : ndarray of shape (o, p)
        Weights with an infinite prior scale; in ``units.prior`` theirs is very wide.
    shapes : tuple of tuple of int
        Of a row's kernel inputs and of its features.
    groups : ndarray of shape (n,), optional
        The group of each row of the source.
    placement : Placement, optional
        Of the inducing points; None for the exact model.
    solver : LBFGS or Adam
    max_iter : int
    tol : float, optional
        In nats; None leaves it to the fit.
    sharing : {"all", "kernel", "none", "auto"} or sequence of sequence of int
    found : bool
        Whether the groups of outputs were found and not given.
    family : {"full", "diagonal"}
        Of q.
    noise_cv : CrossValidation, optional
        By which signal and noise are calibrated.
    noise : Gaussian or StudentT
        Model of the noise.
    row_variance : ndarray of shape (n, o), optional
        Noise variances of the rows in units of σ², on top of what the source knows. Outputs of a model share the mean.
    n_threads : int
        For independent models, or else for blocks of rows.
    """

    source: Source
    units: Units
    spec: KernelSpec
    vague: np.ndarray
    shapes: RowShapes
    groups: np.ndarray | None = None
    placement: Placement = field(default_factory=lambda: Placement("auto", 0))
    solver: LBFGS | Adam = field(default_factory=LBFGS)
    max_iter: int = 0
    tol: float | None = None
    sharing: Sharing = "all"
    found: bool = False
    family: PosteriorFamily = "full"
    noise_cv: CrossValidation | None = None
    noise: Gaussian | StudentT = field(default_factory=Gaussian)
    row_variance: np.ndarray | None = None
    n_threads: int = 1

    @classmethod
    def from_data(
        cls,
        data: Dataset,
        *,
        kernel: Any,
        coef_prior: CoefPrior,
        noise: Gaussian | StudentT,
        normalize_y: bool,
        allow_vague: bool = False,
    ) -> Problem:
        """Look at the rows: the kernel's start, the prior of the weights, and the internal units.

        ``allow_vague`` allows weights of which nothing is known before.
        """
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
                    f"WhiteKernel of kernel={kernel!r}; give one of them."
                )
            spec = spec.with_noise(noise.variance)
        prior, vague = _prior(coef_prior, data, features, targets, allow_vague)
        target_mean = targets.mean if normalize_y else np.zeros(len(targets.mean))
        units = Units.of(data.source, features, targets, target_mean, prior)
        with np.errstate(over="ignore"):
            spread = prior.scale * features.largest / units.target_unit[:, np.newaxis]
        check_magnitude(
            spread,
            "the prior standard deviation of coef_ times features, in units of what these leave of y,",
            _LARGEST_SPREAD,
        )
        shapes = inputs.mean.shape, features.mean.shape
        return cls(data.source, units, spec, vague, shapes, data.groups, noise=noise)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.units.target_unit)

    @property
    def n_columns(self) -> int:
        """Width of the kernel's inputs."""
        return self.shapes[0][-1]

    @property
    def per_output(self) -> bool:
        """Whether outputs have inputs or features of their own."""
        return max(map(len, self.shapes)) > 1

    @property
    def rules(self) -> Rules:
        """The numbers that the search goes by."""
        return rules_of(self.solver)

    def check(self) -> None:
        """Refuse what the solver or the diagonal q cannot fit, such as weights that are shared or correlated."""
        solver, prior, is_adam = self.solver, self.units.prior, isinstance(self.solver, Adam)
        if is_adam and self.per_output and isinstance(self.sharing, str) and self.sharing == "kernel":
            raise ValueError(
                'sharing="kernel" of outputs with rows of their own needs solver="lbfgs" or an LBFGS(...); got '
                f"solver={solver!r}."
            )
        told = "shared=True of CoefPrior" if prior.shared else "a covariance of the weights (cov of CoefPrior)"
        if prior.root is None and not prior.shared:
            return
        if is_adam:
            raise ValueError(f'{told} needs solver="lbfgs" or an LBFGS(...); got solver={solver!r}.')
        if self.family == "diagonal":
            raise ValueError(f'{told} needs posterior="full"; got posterior={self.family!r}.')


def _prior(
    asked: CoefPrior, data: Dataset, features: Moments, targets: Moments, allow_vague: bool
) -> tuple[CoefficientPrior, np.ndarray]:
    """The weights' prior, in the user's units, and which of them (o, p) are vague."""
    o, shared, feature_map = len(targets.mean), asked.shared, data.maps.feature_map
    if isinstance(shared, str):
        shared = says_shared(feature_map)
    elif shared and feature_map is None:
        raise ValueError("shared=True of CoefPrior needs a feature_map: without one there are no weights to share.")
    shared = bool(shared) and o > 1 and feature_map is not None
    # Bumps far from all rows, say, are as good as 0.
    size = np.where(features.largest > _NEGLIGIBLE * features.largest.max(initial=0.0), features.rms, 0.0)
    wide = wide_scale(size, np.sqrt(targets.variance), targets.largest, shared)
    mean, scale, root = resolved(asked, feature_map, data.given, wide, o, allow_vague)
    vague = np.isinf(scale)
    # For an infinite prior scale, one so wide that it does not matter.
    scale = np.where(vague, _VAGUE * wide_scale(size, targets.largest, targets.largest, shared), scale)
    if shared:
        mean, scale, vague = (np.repeat(values, o, axis=0) for values in (mean, scale, vague))
        root = None if root is None else np.repeat(root, o, axis=0)
    return CoefficientPrior(mean, scale, np.zeros(scale.shape), root, shared), vague

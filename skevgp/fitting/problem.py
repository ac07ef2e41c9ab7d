"""A problem: what is asked of a fit. The estimators make it, and the fit reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ..data.rows import Source
from ..kernels.parse import KernelSpec
from ..model.bounds import PosteriorFamily
from ..solvers import LBFGS, Adam
from .calibration import CrossValidation
from .inducing import Placement
from .search import Rules, rules_of
from .units import Units

Sharing = Literal["all", "kernel", "none", "auto"] | Sequence[Sequence[int]]


@dataclass(frozen=True)
class Problem:
    """What is asked of a fit: the rows, the model, and how its parameters are found.

    Attributes
    ----------
    data : tuple
        X as the maps see it, X as an array, y, and which rows count.
    source : Source
        The rows through both maps, in the user's units.
    units : Units
        The internal units, and the prior of the weights.
    spec : KernelSpec
        What the user says of kernel and noise.
    vague : ndarray of shape (o, p)
        Weights with an infinite prior scale; in ``units.prior`` theirs is very wide.
    n_columns : int
        Width of the kernel's inputs.
    per_output : bool
        Whether outputs have inputs or features of their own.
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
    heavy_tails : bool
        Whether the noise has a Student-t's tails.
    row_variance : ndarray of shape (n, o), optional
        Noise variances of the rows in units of σ², on top of what the source knows. Outputs of a model share the mean.
    n_threads : int
        For independent models, or else for blocks of rows.
    """

    data: tuple[Any, Any, np.ndarray, Any]
    source: Source
    units: Units
    spec: KernelSpec
    vague: np.ndarray
    n_columns: int
    per_output: bool = False
    groups: np.ndarray | None = None
    placement: Placement = field(default_factory=lambda: Placement("auto", 0))
    solver: LBFGS | Adam = field(default_factory=LBFGS)
    max_iter: int = 0
    tol: float | None = None
    sharing: Sharing = "all"
    found: bool = False
    family: PosteriorFamily = "full"
    noise_cv: CrossValidation | None = None
    heavy_tails: bool = False
    row_variance: np.ndarray | None = None
    n_threads: int = 1

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.units.target_unit)

    @property
    def rules(self) -> Rules:
        """The numbers that the search goes by."""
        return rules_of(self.solver)

    def check(self) -> None:
        """Refuse what the solver or the diagonal q cannot fit, such as weights that are shared or correlated."""
        solver, prior, is_adam = self.solver, self.units.prior, isinstance(self.solver, Adam)
        if isinstance(solver, Adam) and solver.natural_gradient and self.family != "full":
            raise ValueError(f'natural_gradient=True of Adam needs posterior="full"; got posterior={self.family!r}.')
        if is_adam and self.per_output and isinstance(self.sharing, str) and self.sharing == "kernel":
            raise ValueError(
                'sharing="kernel" of outputs with rows of their own needs solver="lbfgs" or an LBFGS(...); got '
                f"solver={solver!r}."
            )
        told = "share_coef=True" if prior.shared else "a covariance of the weights (coef_cov)"
        if prior.root is None and not prior.shared:
            return
        if is_adam:
            raise ValueError(f'{told} needs solver="lbfgs" or an LBFGS(...); got solver={solver!r}.')
        if self.family == "diagonal":
            raise ValueError(f'{told} needs posterior="full"; got posterior={self.family!r}.')

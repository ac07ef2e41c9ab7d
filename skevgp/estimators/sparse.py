"""The sparse model but for its arguments: what a fit asks for, new rows that are folded in, other kernels tried."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import ArrayLike

from ..data.threads import single_threaded_libraries
from ..data.weights import chosen_rows
from ..fitting.calibration import CrossValidation
from ..fitting.fit import Fitted, fit_model
from ..fitting.inducing import Placement
from ..fitting.problem import Problem, Sharing
from ..noise.inputs import fit_to_noisy_inputs, input_covariance, relative_noise, variance_by_inputs
from ..solvers import LBFGS, Adam, as_solver
from ..utils.monitor import Monitor
from ..utils.sklearn import fit_context
from ..utils.validation import check_magnitude, is_dask, unchanged_if_it_fails
from .base import ExplicitGaussianProcess


class SparseGaussianProcess(ExplicitGaussianProcess):
    """A Gaussian process with explicit features and inducing points, however it is fitted."""

    n_inducing: int | Literal["auto"]
    max_inducing: int
    inducing_init: Any
    sharing: Sharing
    posterior: Literal["full", "diagonal"]
    noise: Literal["gaussian", "student-t"]
    noise_cv: int | None
    input_noise: ArrayLike | None
    solver: Literal["lbfgs", "adam"] | LBFGS | Adam
    max_iter: int | None
    tol: float | Literal["auto"]
    forgetting_factor: float
    n_jobs: int | None

    _fitted: Fitted
    _training_data: tuple[Any, Any, np.ndarray, Any] | None = None

    @fit_context(prefer_skip_nested_validation=False)
    def partial_fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        relative_variance: ArrayLike | None = None,
    ) -> Self:
        """Fold new rows into the posterior exactly, keeping kernel, noise and inducing points.

        The first call is a `fit`. With ``forgetting_factor`` below 1 earlier rows count less. After Adam, q moves to
        its optimum. The rows seen before are known by their sums only: where the noise is below 1e-8 of the signal,
        ``lower_bound_`` and ``upper_bound_`` are good to about a nat.

        Parameters
        ----------
        X : array-like or dask.array.Array of shape (n_samples, n_features)
            The first rows should be like all: they place the inducing points (no more than there are rows), kernel and
            noise.
        y : array-like or dask.array.Array of shape (n_samples,) or (n_samples, n_outputs)
            With as many outputs as in the first call.
        sample_weight, relative_variance : array-like or dask.array.Array of shape (n_samples,), default=None
            Of the new rows, as of `fit`.

        Returns
        -------
        self : object
            The estimator itself, with the new rows in its posterior.

        Raises
        ------
        ValueError, TypeError
            As `fit`, and if y does not have the outputs of the first call.
        """
        if not hasattr(self, "_fitted"):
            return self.fit(X, y, sample_weight, relative_variance=relative_variance)
        self._validate_params()  # scikit-learn leaves it out for a model that is fitted
        if self._fitted.row_scales is not None and (is_dask(X) or self.forgetting_factor < 1.0):
            raise ValueError(
                'With noise="student-t", partial_fit needs rows in memory or in a file, and forgetting_factor=1 (what '
                f"changes would be taken for outliers); got forgetting_factor={self.forgetting_factor!r}."
            )
        with unchanged_if_it_fails(self), single_threaded_libraries():
            given, X, y = self._validated(X, y)
            n_outputs = 1 if y.ndim == 1 else y.shape[1]
            if n_outputs != self._n_outputs:
                raise ValueError(f"y has {n_outputs} outputs, but the model has {self._n_outputs}.")
            chosen = chosen_rows(X, y, sample_weight, relative_variance, ordered=False)
            source = self._source(given, X, y, chosen, self._row_shapes)
            residuals = self._fitted.units.rows(source).residuals
            check_magnitude(residuals.largest, "y, in units of what the first fit left over,")
            noisier = None
            if self.input_noise is not None:
                covariance = input_covariance(self.input_noise, self.n_features_in_)
                by_inputs = variance_by_inputs(self, given, X, chosen, covariance)
                noisier = relative_noise(by_inputs, self._predictor.noise, chosen)
            self._fitted = self._fitted.updated(source, self.forgetting_factor, noisier)
            self._training_data = None
            self._set_posterior()
            self._set_weights(chosen)
        return self

    def set_params(self, **params: Any) -> Self:
        """Set parameters; by ``solver__...`` a solver that is a string becomes what it stands for.

        Parameters
        ----------
        **params : dict
            Parameters of the estimator, and of what it is made of.

        Returns
        -------
        self : object
            The estimator itself.
        """
        if isinstance(self.solver, str) and any(name.startswith("solver__") for name in params):
            self.solver = as_solver(self.solver)
        return super().set_params(**params)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_training_data"}

    @property
    def lower_bound_(self) -> float:
        """On the log marginal likelihood at the fitted parameters, in nats, summed over outputs."""
        return self._known("lower_bound")

    @property
    def upper_bound_(self) -> float:
        """What the log marginal likelihood cannot exceed; likewise."""
        return self._known("upper_bound")

    def _known(self, name: str) -> float:
        # After partial_fit they are found when somebody asks.
        if not hasattr(self, "_fitted"):
            raise AttributeError(f"{type(self).__name__} has {name}_ only after fit.")
        with single_threaded_libraries():
            return float(getattr(self._fitted, name))

    def _set_weights(self, chosen: Any) -> None:
        """How much each of the user's rows is doubted."""
        scales = self._fitted.row_scales
        if scales is None:
            self.__dict__.pop("weights_", None)
            return
        model_of = [next(i for i, own in enumerate(self._fitted.outputs) if o in own) for o in range(self._n_outputs)]
        weights = chosen.as_given(scales[:, model_of])
        self.weights_ = weights[:, 0] if self._single_output else weights

    def _set_attributes(self) -> None:
        self._set_common_attributes()
        fitted = self._fitted
        points = [group.points for group in self._predictor.by_output]
        same = len({len(own) for own in points}) == 1
        self.inducing_points_: Any = np.array(points) if same else points
        sets = [own for one in fitted.models for own in one.values["inducing_points"]]
        if len(sets) == 1:
            self.inducing_points_ = points[0]
        self.sharing_ = fitted.sharing
        self.loss_curve_ = fitted.loss_curve
        self.n_iter_ = fitted.n_iter
        self.n_parameters_ = fitted.n_parameters

    def _check_noise(self, solver: LBFGS | Adam, X: Any) -> None:
        """Noise that not all solvers and rows can have."""
        asked = ('noise="student-t"', self.noise == "student-t"), ("input_noise", self.input_noise is not None)
        for name, is_asked in asked:
            if is_asked and (isinstance(solver, Adam) or is_dask(X)):
                raise ValueError(
                    f'{name} needs solver="lbfgs" or an LBFGS(...), and rows in memory or in a file; got '
                    f"solver={self.solver!r} and X of type {type(X).__name__}."
                )
        if all(is_asked for _, is_asked in asked):
            raise ValueError('input_noise and noise="student-t" do not go together; give one of them.')

    def _with_noisy_inputs(self, problem: Problem, rng: np.random.RandomState, monitor: Monitor) -> Fitted:
        """The fit once its rows are as noisy as their inputs make them."""
        assert self.input_noise is not None
        assert self._training_data is not None
        covariance = input_covariance(self.input_noise, self.n_features_in_)

        def refit(variance: np.ndarray, before: Fitted) -> Fitted:
            return fit_model(replace(problem, row_variance=variance), rng, monitor, before)

        return fit_to_noisy_inputs(self, self._fitted, self._training_data, covariance, refit, monitor)

    def _asked(self, problem: Problem, solver: LBFGS | Adam) -> Problem:
        """The problem with what the arguments say of the fits."""
        folds = self.noise_cv
        free_signal = problem.spec.starts.signal.bounds is None
        return replace(
            problem,
            sharing=self.sharing,
            family=self.posterior,
            placement=Placement.of(self.inducing_init, self.n_inducing, self.max_inducing, problem.n_columns),
            solver=solver,
            max_iter=solver.default_max_iter if self.max_iter is None else self.max_iter,
            tol=None if isinstance(self.tol, str) else self.tol,
            noise_cv=None if folds is None else CrossValidation(folds, problem.groups, free_signal),
            n_threads=effective_n_jobs(self.n_jobs),
            heavy_tails=self.noise == "student-t",
        )

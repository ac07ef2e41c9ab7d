"""EVGPRegressor: explicit physics features plus a sparse variational Gaussian process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from numbers import Integral
from typing import Any, ClassVar, Literal, Self

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin
from sklearn.gaussian_process.kernels import Kernel
from sklearn.utils import check_random_state

from ..control.posterior import Posterior
from ..data.dataset import Dataset, checked_numbers
from ..data.threads import single_threaded_libraries
from ..exceptions import DependentRowsWarning, warn_user
from ..fitting.fit import fit_model
from ..fitting.fitted import Fitted
from ..fitting.folds import CrossValidation
from ..fitting.inducing import Placement
from ..fitting.local import gain_of_neighbours
from ..fitting.messages import DEPENDENT_ROWS, interrupted
from ..fitting.noisy_inputs import fit_to_noisy_inputs, look_at_slopes
from ..fitting.prior import CoefPrior, as_coef_prior
from ..fitting.problem import Problem, Sharing
from ..fitting.theta import ROUGH_ITER, after_more_rows, calibrate, rough_tol
from ..model.bounds import Variant
from ..noise import as_noise
from ..noise.base import Noise
from ..noise.gaussian import input_covariance, relative_noise
from ..solvers import as_solver, solvers_of_all_rows
from ..solvers.base import Solver
from ..utils.monitor import monitor_of
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.validation import (
    check_integer,
    check_magnitude,
    check_real,
    is_dask,
    is_frame,
    unchanged_if_it_fails,
    words_of,
)
from .base import GaussianProcess


class EVGPRegressor(GaussianProcess):
    r"""Sparse variational Gaussian process with explicit features (EVGP).

    The model of each output is

    .. math:: y = h(x)^\top \beta + f(x) + \varepsilon, \quad \beta \sim N(\mu_\beta, \Sigma_\beta), \quad
              f \sim GP(0, k), \quad \varepsilon \sim N(0, \sigma^2).

    The features h are known, such as approximate physics or a trend. The Gaussian process f learns the residual with
    ``n_inducing`` inducing points. Time is linear in the number of rows. Without a feature map, the model is the sparse
    Gaussian process of Titsias (2009). See the user guide, :doc:`/guide/model`.

    Parameters
    ----------
    feature_map : transformer, default=None
        Transformer x -> h(x), for example `InertiaForceGravity("pendulum")`. It gets X as given, so do not scale the
        columns of X. It may return a row for each output, of shape (n, n_outputs, n_h).
    kernel : sklearn.gaussian_process.kernels.Kernel or callable, default=None
        Covariance of f: sums and products of the kernels that `skevgp.kernels` lists, or a function in autograd.numpy
        (`FunctionKernel`). If None, an RBF with a length scale for each column.
    kernel_map : transformer, default=None
        Transformer x -> inputs of the kernel, for example a `StandardScaler`. Only the kernel gets its result.
    coef_prior : skevgp.CoefPrior or "auto", default="auto"
        Prior of the weights β. If ``"auto"``, that of the feature map. See :doc:`/guide/priors`.
    n_inducing : int or "auto", default=100
        Number of inducing points. If ``"auto"``, it grows while this raises the bound. See
        :doc:`/howto/inducing_points`.
    n_neighbors : int, default=0
        Number of training rows near a row on which the residual of the inducing points is conditioned. With thousands
        of rows, try 60. If 0, the model has the inducing points only. See :doc:`/guide/neighbors`.
    inducing_init : {"auto", "k-means", "greedy"} or array-like of shape (m, d), default="auto"
        Start of the inducing points: cluster centres, rows of large residual variance (``"greedy"``), or points in the
        space of ``kernel_map``. If ``"auto"``, L-BFGS tries both.
    sharing : {"auto", "all", "kernel", "none"} or list of list of int, default="auto"
        Parameters that outputs share: inducing points and kernel shape (``"all"``), kernel shape (``"kernel"``), or
        none. Lists are groups of outputs that share all. If ``"auto"``, short fits find groups. See
        :doc:`/guide/sharing`.
    noise : {"gaussian", "student-t"}, `skevgp.noise.Gaussian` or `skevgp.noise.StudentT`, default="gaussian"
        Noise model. Use ``"student-t"`` if a few rows are outliers, and ``Gaussian(inputs=...)`` for noise in X.
    discrepancy : {"free", "orthogonal"}, default="free"
        Whether f is independent of the features (``"free"``), or orthogonal to them. See :doc:`/guide/parameters`.
    noise_cv : int, default=5
        Number of folds that calibrate signal and noise variance. If None, there is no calibration. See
        :doc:`/guide/noise`.
    normalize_y : bool, default=False
        Whether the prior mean is the training mean of y instead of 0.
    solver : {"lbfgs", "adam"}, `skevgp.solvers.LBFGS` or `skevgp.solvers.Adam`, default="lbfgs"
        Optimiser: L-BFGS on all rows, or Adam on mini-batches. Solver objects have further options. See
        :doc:`/guide/solvers`.
    max_iter : int, default=None
        Maximum number of iterations. If None, 1000 for L-BFGS and 16000 for Adam.
    warm_start : bool, default=False
        Whether to start from the result of the last fit.
    n_jobs : int, default=None
        Number of threads. If None, 1; if -1, all cores.
    random_state : int, RandomState instance or None, default=None
        Seed of inducing points, mini-batches and restarts.
    verbose : int, default=0
        Verbosity: 0 prints nothing, 1 shows the progress, and 2 prints a line at each iteration.

    Attributes
    ----------
    coef_, coef_std_ : ndarray of shape (n_h,) or (n_outputs, n_h)
        Posterior means and standard deviations of the weights. They exist only with a ``feature_map``. The axis of
        outputs is left out if y has one column or outputs share their weights.
    coef_cov_ : ndarray of shape (n_h, n_h) or (n_outputs, n_h, n_h)
        Posterior covariances of the weights.
    coef_names_ : ndarray of str of shape (n_h,)
        Names of the features.
    coef_prior_mean_, coef_prior_scale_ : ndarray of the shape of ``coef_``
        Prior means and standard deviations of the weights.
    coef_groups_ : ndarray of str of the shape of ``coef_``
        Group of each weight (see `CoefPrior`).
    theta_, theta_std_ : dict of str to float
        Posterior medians and standard deviations of the parameters of `skevgp.features.ParametricFeatures` and similar
        maps.
    theta_cov_ : ndarray of shape (n_theta, n_theta)
        Posterior covariance of these parameters.
    feature_map_, kernel_map_ : transformer or None
        Fitted clones of the maps.
    inducing_points_ : ndarray of shape (m, d) or, for several outputs unless all share them, (n_outputs, m, d)
        Inducing points in the space of ``kernel_map``.
    sharing_ : list of list of int
        Groups of outputs that share a kernel.
    kernel_ : Kernel, or list of Kernel for several outputs
        Fitted kernel without noise. With few rows, it is the most likely one (see :doc:`/guide/few_rows`).
    noise_variance_ : float or ndarray of shape (n_outputs,)
        Noise variance σ² in squared units of y. With few rows, it is the mean over the kernels that are averaged.
    weights_ : ndarray of shape (n_samples,) or (n_samples, n_outputs)
        Factor on the precision of each row: 1 for ordinary rows, and near 0 for outliers. It exists only with
        ``noise="student-t"``.
    lower_bound_, upper_bound_ : float
        Bounds on the log marginal likelihood in nats, summed over outputs, for the fitted kernel and the calibrated
        noise. If they agree, more inducing points do not help this kernel. With ``n_neighbors``, the first is the log
        likelihood of the approximation, which is no bound, and the second is inf.
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the lower bound per iteration. With ``n_neighbors``, that of the sparse fit which comes first. With few
        rows, minus the sum of the bound and the log prior of kernel and noise.
    n_iter_ : int
        Number of iterations of the best start.
    n_parameters_ : int
        Number of parameters that are fitted.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    EGPRegressor : The same model without inducing points, for up to about 2,000 rows.
    sklearn.gaussian_process.GaussianProcessRegressor : The exact Gaussian process without features.

    References
    ----------
    - D. L. Marino, M. Manic (2020): Physics Enhanced Data-Driven Models with Variational Gaussian Processes.
    - M. K. Titsias (2009): Variational Learning of Inducing Variables in Sparse Gaussian Processes.

    Examples
    --------
    Learn a wave on a linear trend, with the explicit features 1 and x:

    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(PolynomialFeatures(1), n_inducing=10, random_state=0).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 2)
    0.96
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "feature_map": "no_validation",
        "kernel": "no_validation",
        "kernel_map": "no_validation",
        "coef_prior": "no_validation",
        "n_inducing": [Interval(Integral, 1, None, closed="left"), StrOptions({"auto"})],
        "inducing_init": [StrOptions({"auto", "k-means", "greedy"}), "array-like"],
        "sharing": [StrOptions({"all", "kernel", "none", "auto"}), "array-like"],
        "noise": "no_validation",
        "discrepancy": [StrOptions({"free", "orthogonal"})],
        "noise_cv": [Interval(Integral, 2, None, closed="left"), None],
        "normalize_y": ["boolean"],
        "solver": "no_validation",
        "n_neighbors": [Interval(Integral, 0, None, closed="left")],
        "max_iter": [Interval(Integral, 0, None, closed="left"), None],
        "warm_start": ["boolean"],
        "n_jobs": [Integral, None],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        feature_map: TransformerMixin | None = None,
        kernel: Kernel | Callable[..., Any] | None = None,
        *,
        kernel_map: TransformerMixin | None = None,
        coef_prior: CoefPrior | Literal["auto"] = "auto",
        n_inducing: int | Literal["auto"] = 100,
        n_neighbors: int = 0,
        inducing_init: Literal["auto", "k-means", "greedy"] | ArrayLike = "auto",
        sharing: Sharing = "auto",
        noise: str | Noise = "gaussian",
        discrepancy: Literal["free", "orthogonal"] = "free",
        noise_cv: int | None = 5,
        normalize_y: bool = False,
        solver: str | Solver = "lbfgs",
        max_iter: int | None = None,
        warm_start: bool = False,
        n_jobs: int | None = None,
        random_state: int | np.random.RandomState | None = None,
        verbose: int = 0,
    ):
        self.feature_map = feature_map
        self.kernel = kernel
        self.kernel_map = kernel_map
        self.coef_prior = coef_prior
        self.n_inducing = n_inducing
        self.n_neighbors = n_neighbors
        self.inducing_init = inducing_init
        self.sharing = sharing
        self.noise = noise
        self.discrepancy = discrepancy
        self.noise_cv = noise_cv
        self.normalize_y = normalize_y
        self.solver = solver
        self.max_iter = max_iter
        self.warm_start = warm_start
        self.n_jobs = n_jobs
        self.random_state = random_state
        self.verbose = verbose

    @fit_context(prefer_skip_nested_validation=False)
    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        groups: ArrayLike | None = None,
        relative_variance: ArrayLike | None = None,
    ) -> Self:
        """Fit kernel, noise, inducing points and posterior.

        Parameters
        ----------
        X : array-like or dask.array.Array of shape (n_samples, n_features)
            Rows, with numbers up to 1e100. The maps get X as given, for example as a data frame. Memory-mapped arrays
            of float64 or float32 are not copied. See :doc:`/howto/dask` on Dask arrays.
        y : array-like or dask.array.Array of shape (n_samples,) or (n_samples, n_outputs)
            Targets, up to 1e100. The largest of a column must be 0 or above 1e-140.
        sample_weight : array-like or dask.array.Array of shape (n_samples,), default=None
            Factor on the log likelihood of each row: 0 removes the row, and 2 counts it twice. Maps get it too, if
            their ``fit`` has a ``sample_weight``.
        groups : array-like of shape (n_samples,), default=None
            Labels of the trajectory of each row, such as ``make_dynamics(...).groups``. ``noise_cv`` then leaves out
            whole groups, so that ``std`` is valid for new trajectories. If None, rows are independent.
        relative_variance : array-like or dask.array.Array of shape (n_samples,), default=None
            Known noise variance of each row in units of σ², the same for all outputs. With ``WhiteKernel(1, "fixed")``
            in the kernel, it is the ``alpha`` of GaussianProcessRegressor. The smallest that counts is 1e-10 of the
            median, because float64 would lose the other rows.

        Returns
        -------
        self : EVGPRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, or shapes do not fit.
        KeyboardInterrupt
            If Ctrl-C is pressed before the fit has parameters to keep.

        Warns
        -----
        ConvergenceWarning
            If the fit ended before it converged, or the Gaussian process learned nothing that holds for left-out
            groups. If y is far from its prior mean, or a parameter of the given kernel is at a bound. The message gives
            advice.
        skevgp.exceptions.DependentRowsWarning
            If neighbouring rows depend on each other and ``groups`` is not given.

        Notes
        -----
        If one group has half of the rows or more, ``noise_cv`` leaves out blocks of successive rows of a group.

        See :doc:`/guide/noise` on the rules of `DependentRowsWarning`.
        """
        solver, noise = as_solver(self.solver), as_noise(self.noise)
        self._check_together(solver, noise, X)
        progress = monitor_of(self.verbose, solver.callback, solver.max_time)
        with unchanged_if_it_fails(self), single_threaded_libraries(), progress as monitor:
            data = Dataset.from_user(self, X, y, sample_weight, relative_variance, groups)
            problem = self._problem(data, solver, noise)
            previous = getattr(self, "_fitted", None) if self.warm_start else None
            rng = check_random_state(self.random_state)
            numbers = None if noise.inputs is None else self._numbers(data)

            def fit(problem: Problem, before: Fitted | None, rough: bool, about: str) -> Fitted:
                if rough:
                    tol = max(problem.tol or 0.0, rough_tol(problem))
                    problem = replace(problem, noise_cv=None, max_iter=min(problem.max_iter, ROUGH_ITER), tol=tol)
                return fit_model(problem, rng, monitor.seen_as(about=about), before)

            calibration = calibrate(data, problem, fit, rng, monitor, (previous, self._theta))
            if calibration is not None:
                data, problem, fitted = calibration.data, calibration.problem, calibration.fitted
            else:
                fitted = fit_model(problem, rng, monitor, previous)
            if numbers is not None and noise.inputs is not None:

                def refit(variance: np.ndarray, before: Fitted) -> Fitted:
                    return fit_model(replace(problem, row_variance=variance), rng, monitor, before)

                covariance = input_covariance(noise.inputs, data.maps.n_columns)
                posterior_of = self._posterior_of(data, problem)
                fitted = fit_to_noisy_inputs(
                    fitted, data, posterior_of, numbers, covariance, refit, monitor, self._columns_changed
                )
            theta = None if calibration is None else calibration.posterior
            self._gain_of_neighbours = None
            if theta is None and problem.max_iter > 0 and not monitor.interrupted:
                self._gain_of_neighbours = gain_of_neighbours(problem, fitted)
            self._set_posterior(data, problem, problem.spec, fitted, theta)
            self._set_attributes(fitted, data)
        self._warn((interrupted(self.n_iter_),) if monitor.interrupted else fitted.messages, problem.spec)
        if calibration is not None:
            calibration.warn()
        if fitted.dependent:
            warn_user(DEPENDENT_ROWS, DependentRowsWarning)
        return self

    @fit_context(prefer_skip_nested_validation=False)
    def partial_fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        relative_variance: ArrayLike | None = None,
        forgetting_factor: float = 1.0,
    ) -> Self:
        """Add new rows to the posterior exactly. Kernel, noise and inducing points stay the same.

        The first call is a `fit`. After a fit by Adam, the approximate posterior q first moves to its optimum. If the
        noise variance is below 1e-8 of the signal variance, the two bounds are accurate to about a nat. Features with
        parameters stay linearised at the ``theta_`` of `fit`. Call `fit` with all rows if ``theta_`` moves far.

        Parameters
        ----------
        X : array-like or dask.array.Array of shape (n_samples, n_features)
            New rows. The rows of the first call should be typical, because they determine inducing points, kernel and
            noise.
        y : array-like or dask.array.Array of shape (n_samples,) or (n_samples, n_outputs)
            Targets, with as many outputs as in the first call.
        sample_weight, relative_variance : array-like or dask.array.Array of shape (n_samples,), default=None
            Weights and relative noise variances of the new rows, as for `fit`.
        forgetting_factor : float, default=1.0
            Factor on the log likelihood of all earlier rows, in (0, 1]. Use a factor below 1 for a system that drifts:
            0.99 remembers about the last hundred calls.

        Returns
        -------
        self : object
            The estimator itself, with the new rows in its posterior.

        Raises
        ------
        ValueError, TypeError
            As for `fit`, and if y does not have the outputs of the first call.
        """
        fading = check_real(forgetting_factor, "forgetting_factor", minimum=0.0, strict=True)
        if fading > 1.0:
            raise ValueError(f"forgetting_factor must be at most 1; got {forgetting_factor!r}.")
        if not self.__sklearn_is_fitted__():
            return self.fit(X, y, sample_weight, relative_variance=relative_variance)
        self._validate_params()  # scikit-learn validates only models that are not fitted
        noise = as_noise(self.noise)
        if self._fitted.row_scales is not None and (is_dask(X) or fading < 1.0):
            raise ValueError(
                f"With noise={self.noise!r}, partial_fit needs rows in memory or in a file, and forgetting_factor=1; "
                f"got forgetting_factor={forgetting_factor!r}."
            )
        if self.n_neighbors and fading < 1.0:
            raise ValueError(
                f"With n_neighbors={self.n_neighbors}, partial_fit needs forgetting_factor=1; got "
                f"forgetting_factor={forgetting_factor!r}."
            )
        with unchanged_if_it_fails(self), single_threaded_libraries():
            maps, fitted = self._posterior.maps, self._fitted
            data = Dataset.further(self, maps, X, y, sample_weight, relative_variance)
            n_outputs = 1 if data.y.ndim == 1 else data.y.shape[1]
            if n_outputs != self._n_outputs:
                raise ValueError(f"y has {n_outputs} outputs, but the model has {self._n_outputs}.")
            residuals = fitted.units.rows(data.source).residuals
            check_magnitude(residuals.largest, "y, in units of the residuals of the first fit,")
            noisier = None
            if noise.inputs is not None:
                covariance, numbers = input_covariance(noise.inputs, maps.n_columns), self._numbers(data)
                by_inputs, _ = look_at_slopes(self._posterior, data, numbers, covariance, self._columns_changed)
                noisier = relative_noise(by_inputs, self._posterior.predictor.noise, data.chosen)
            self._fitted = fitted.updated(data.source, fading, noisier)
            found = self._fitted.predictor()
            if self._theta is not None:
                self._theta, self._fitted = after_more_rows(self._theta, maps.feature_map, self._fitted)
                found = self._theta.predictor(self._fitted)
            self._posterior, self._gain_of_neighbours = replace(self._posterior, predictor=found), None
            self._set_weights_and_noise()
            self._set_weights_of_rows(data)
        return self

    @property
    def lower_bound_(self) -> float:
        """Lower bound on the log marginal likelihood at the fitted parameters, in nats, summed over outputs.

        With ``n_neighbors``, it is the log likelihood of the approximation, which is no bound.
        """
        # After partial_fit it is computed when it is read.
        with single_threaded_libraries():
            return float(self._fitted.lower_bound) - self._counted_twice

    @property
    def upper_bound_(self) -> float:
        """Upper bound on the log marginal likelihood at the fitted parameters, in nats, summed over outputs."""
        with single_threaded_libraries():
            return float(self._fitted.upper_bound) - self._counted_twice

    # Columns of X that were subtracted from y, so that their noise is in y too. `ResidualRegressor` sets them.
    _columns_changed: np.ndarray | None = None

    def _check_together(self, solver: Solver, noise: Noise, X: Any) -> None:
        """Raise an error for combinations of arguments that are not supported."""
        if not isinstance(self.n_inducing, str):
            check_integer(self.n_inducing, "n_inducing", minimum=1)
        elif solver.stochastic:
            raise ValueError(f'n_inducing="auto" needs {solvers_of_all_rows()}; got solver={self.solver!r}.')
        if check_integer(self.n_neighbors, "n_neighbors", minimum=0):
            self._check_local(solver, noise, X)
        asked = f"noise={self.noise!r}" if noise.heavy_tails else "inputs of Gaussian noise"
        if (noise.heavy_tails or noise.inputs is not None) and (solver.stochastic or is_dask(X)):
            raise ValueError(
                f"{asked} needs {solvers_of_all_rows()}, and rows in memory or in a file; got "
                f"solver={self.solver!r} and X of type {type(X).__name__}."
            )

    def _check_local(self, solver: Solver, noise: Noise, X: Any) -> None:
        """Raise an error for arguments that a model with a local part does not support."""
        unsupported = {
            f"solver={self.solver!r}": solver.stochastic or solver.posterior != "full",
            f"noise={self.noise!r}": noise.heavy_tails or noise.inputs is not None,
            f"discrepancy={self.discrepancy!r}": self.discrepancy == "orthogonal",
            f"X of type {type(X).__name__}": is_dask(X),
        }
        for name, refused in unsupported.items():
            if refused:
                raise ValueError(f"n_neighbors={self.n_neighbors} does not support {name}. Use n_neighbors=0.")

    def _problem(self, data: Dataset, solver: Solver, noise: Noise) -> Problem:
        prior = as_coef_prior(self.coef_prior)
        problem = Problem.from_data(
            data, kernel=self.kernel, coef_prior=prior, noise=noise, normalize_y=self.normalize_y
        )
        folds, tol, most = self.noise_cv, solver.tol, solver.max_inducing
        problem = replace(
            problem,
            sharing=self.sharing,
            variant=Variant(
                solver.posterior, solver.bound == "tight", self.discrepancy == "orthogonal", self.n_neighbors
            ),
            placement=Placement.of(self.inducing_init, self.n_inducing, most, problem.n_columns),
            solver=solver,
            max_iter=solver.default_max_iter if self.max_iter is None else self.max_iter,
            tol=None if isinstance(tol, str) else tol,
            noise_cv=None
            if folds is None
            else CrossValidation(folds, problem.groups, problem.spec.starts.signal.bounds is None),
            averages=noise.inputs is None,
            n_threads=effective_n_jobs(self.n_jobs),
        )
        problem.check()
        return problem

    def _posterior_of(self, data: Dataset, problem: Problem) -> Callable[[Fitted], Posterior]:
        maps = replace(data.maps, shapes=problem.shapes)
        return lambda fitted: Posterior(fitted.predictor(), maps)

    def _numbers(self, data: Dataset) -> np.ndarray:
        """Return X as numbers, for the noise of X."""
        try:
            # During a fit, the maps are not attributes yet.
            self.kernel_map_ = data.maps.kernel_map
            return checked_numbers(self, data.given)[0] if is_frame(data.given) else data.X
        except ValueError as error:
            words = words_of(data.given) if is_frame(data.given) else []
            which = f" The columns {words} are not numbers." if words else ""
            raise ValueError(f"inputs of Gaussian noise needs numbers in X without missing values.{which}") from error

    def _set_attributes(self, fitted: Fitted, data: Dataset) -> None:
        points = [group.points for group in fitted.at_mode.predictor().by_output]
        same = len({len(own) for own in points}) == 1
        self.inducing_points_: Any = np.array(points) if same else points
        if sum(len(one.values["inducing_points"]) for one in fitted.models) == 1:
            self.inducing_points_ = points[0]
        self.sharing_ = fitted.sharing
        self.loss_curve_ = fitted.loss_curve
        self.n_iter_ = fitted.n_iter
        self.n_parameters_ = fitted.n_parameters
        self._set_weights_of_rows(data)

    def _set_weights_of_rows(self, data: Dataset) -> None:
        """Set ``weights_`` of the user's rows if the noise model has outliers."""
        scales, outputs = self._fitted.row_scales, self._fitted.outputs
        if scales is None:
            self.__dict__.pop("weights_", None)
            return
        model_of = [next(i for i, own in enumerate(outputs) if o in own) for o in range(self._n_outputs)]
        weights = data.chosen.as_given(scales[:, model_of])
        self.weights_ = weights[:, 0] if self._n_outputs == 1 else weights

"""EGPRegressor: explicit physics features plus an exact Gaussian process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin, clone
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process.kernels import Kernel
from sklearn.utils import check_random_state

from ..control.posterior import Posterior
from ..data.dataset import Dataset
from ..data.threads import single_threaded_libraries
from ..fitting.fit import fit_model
from ..fitting.fitted import Fitted
from ..fitting.inducing import Placement
from ..fitting.messages import interrupted
from ..fitting.prior import CoefPrior, as_coef_prior
from ..fitting.problem import Problem
from ..fitting.start import prior_predictor
from ..fitting.theta import calibrate, rough_tol
from ..model.bounds import Variant
from ..model.exact import ExactModel, LikelihoodObjective
from ..model.posterior import ExactPosterior
from ..noise import Gaussian, as_noise
from ..solvers import LBFGS
from ..solvers.base import Minimum, Solver, Tolerance
from ..solvers.coordinates import Limits
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor, monitor_of
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.validation import LARGEST, as_floats, check_fitted, is_dask, unchanged_if_it_fails
from .base import GaussianProcess

# Number of rows up to which an iteration takes a few milliseconds at most.
_FEW_ROWS = 100


class EGPRegressor(GaussianProcess):
    r"""Exact Gaussian process with explicit features (EGP).

    The model of each output is that of `EVGPRegressor`,

    .. math:: y = h(x)^\top \beta + f(x) + \varepsilon, \quad \beta \sim N(\mu_\beta, \Sigma_\beta), \quad
              f \sim GP(0, k), \quad \varepsilon \sim N(0, \sigma^2),

    without approximation. Time is cubic and memory quadratic in the number of rows. Use it for up to about 2,000
    rows.

    Parameters
    ----------
    feature_map : transformer, default=None
        Transformer x -> h(x), as in `EVGPRegressor`.
    kernel : sklearn.gaussian_process.kernels.Kernel or callable, default=None
        Covariance of f, as in `EVGPRegressor`. Outputs share its shape, and have their own signal variances.
    kernel_map : transformer, default=None
        Transformer x -> inputs of the kernel, as in `EVGPRegressor`.
    coef_prior : skevgp.CoefPrior or "auto", default="auto"
        Prior of the weights β. If ``"auto"``, that of the feature map. ``CoefPrior(scale=np.inf)`` is vague.
    noise : "gaussian" or `skevgp.noise.Gaussian`, default="gaussian"
        Noise model.
    alpha : float, default=None
        Known noise variance. If None, it is learned.
    discrepancy : {"free", "orthogonal"}, default="free"
        Whether f is independent of the features or orthogonal to them, as in `EVGPRegressor`.
    normalize_y : bool, default=False
        Whether the prior mean is the training mean of y instead of 0.
    optimizer : "fmin_l_bfgs_b", callable or None, default="fmin_l_bfgs_b"
        Optimiser of kernel and noise, with the interface of `GaussianProcessRegressor` (see Notes). If None, the kernel
        is used as given.
    max_iter : int, default=1000
        Maximum number of iterations from each start.
    max_time : float, default=None
        Number of seconds until iterations end. The best parameters so far are kept.
    n_restarts : int, default=0
        Number of further fits from random starts. The likeliest fit is kept.
    tol : float or "auto", default="auto"
        Tolerance in nats, as in `skevgp.solvers.LBFGS`. If ``"auto"``, 0.01, or 1e-9 for 100 rows or fewer.
    n_targets : int, default=None
        Number of outputs, for `predict` and `sample_y` before a fit. If None, 1.
    random_state : int, RandomState instance or None, default=None
        Seed of the restarts.
    verbose : int, default=0
        Verbosity, as in `EVGPRegressor`. The bound is the log marginal likelihood.

    Attributes
    ----------
    coef_, coef_std_ : ndarray of shape (n_h,) or (n_outputs, n_h)
        Posterior means and standard deviations of the weights.
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
    kernel_ : Kernel, or list of Kernel for several outputs
        Fitted kernel without noise. With few rows, it is the most likely one (see :doc:`/guide/few_rows`).
    noise_variance_ : float or ndarray of shape (n_outputs,)
        Noise variance σ² in squared units of y. With few rows, it is the mean over the kernels that are averaged.
    log_marginal_likelihood_value_ : float
        Log marginal likelihood in nats, summed over outputs. With a vague prior of the weights, it is eq. 2.45 of
        Rasmussen & Williams (2006).
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the sum of the log marginal likelihood and the log prior density of learned scales of weights, per
        iteration. With few rows, kernel and noise have a prior too.
    n_iter_ : int
        Number of iterations of the best start.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    EVGPRegressor : The same model with inducing points, for any number of rows.

    Notes
    -----
    A callable ``optimizer(objective, theta, bounds=bounds) -> (theta, value)`` minimises ``objective(theta,
    eval_gradient=True) -> (value, gradient)``. The vector theta has the logarithms of the free hyperparameters, of the
    signal variances and of the noise variances.

    References
    ----------
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, section 2.7.

    Examples
    --------
    Learn a wave on an unknown linear trend:

    >>> import numpy as np
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import CoefPrior, EGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=np.inf)).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 2)
    0.96

    Before a fit, predictions are those of the prior, for a y of size one:

    >>> prior = EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=[0.0, 2.0]))
    >>> prior.predict([[0.0], [3.0]], return_std=True)[1].round(2)
    array([1.  , 6.08])
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "feature_map": "no_validation",
        "kernel": "no_validation",
        "kernel_map": "no_validation",
        "coef_prior": "no_validation",
        "noise": "no_validation",
        "alpha": [Interval(Real, 0, None, closed="neither"), None],
        "discrepancy": [StrOptions({"free", "orthogonal"})],
        "normalize_y": ["boolean"],
        "optimizer": [StrOptions({"fmin_l_bfgs_b"}), callable, None],
        "max_iter": [Interval(Integral, 0, None, closed="left")],
        "max_time": [Interval(Real, 0, None, closed="neither"), None],
        "n_restarts": [Interval(Integral, 0, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left"), StrOptions({"auto"})],
        "n_targets": [Interval(Integral, 1, None, closed="left"), None],
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
        noise: Literal["gaussian"] | Gaussian = "gaussian",
        alpha: float | None = None,
        discrepancy: Literal["free", "orthogonal"] = "free",
        normalize_y: bool = False,
        optimizer: Callable[..., Any] | Literal["fmin_l_bfgs_b"] | None = "fmin_l_bfgs_b",
        max_iter: int = 1000,
        max_time: float | None = None,
        n_restarts: int = 0,
        tol: float | Literal["auto"] = "auto",
        n_targets: int | None = None,
        random_state: int | np.random.RandomState | None = None,
        verbose: int = 0,
    ):
        self.feature_map = feature_map
        self.kernel = kernel
        self.kernel_map = kernel_map
        self.coef_prior = coef_prior
        self.noise = noise
        self.alpha = alpha
        self.discrepancy = discrepancy
        self.normalize_y = normalize_y
        self.optimizer = optimizer
        self.max_iter = max_iter
        self.max_time = max_time
        self.n_restarts = n_restarts
        self.tol = tol
        self.n_targets = n_targets
        self.random_state = random_state
        self.verbose = verbose

    @fit_context(prefer_skip_nested_validation=False)
    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        relative_variance: ArrayLike | None = None,
    ) -> Self:
        """Fit kernel and noise. The posterior is exact.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows, with numbers up to 1e100. The maps get X as given, for example as a data frame.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets, up to 1e100. The largest of a column must be 0 or above 1e-140.
        sample_weight, relative_variance : array-like of shape (n_samples,), default=None
            Weights and relative noise variances of the rows, as in `EVGPRegressor.fit`.

        Returns
        -------
        self : EGPRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, shapes do not fit, or features with vague
            weights are linearly dependent.

        Warns
        -----
        ConvergenceWarning
            If the fit ended before it converged. If the Gaussian process learned nothing, y is far from its prior mean,
            or a parameter of the given kernel is at a bound. The message gives advice.
        """
        if is_dask(X):
            raise TypeError("X is a Dask array, but the exact model needs all rows in memory. Use EVGPRegressor.")
        progress = monitor_of(self.verbose, max_time=self.max_time)
        with unchanged_if_it_fails(self), single_threaded_libraries(), progress as monitor:
            data = Dataset.from_user(self, X, y, sample_weight, relative_variance)
            problem = replace(self._problem(data), max_iter=0 if self.optimizer is None else self.max_iter)
            rng, vague = check_random_state(self.random_state), problem.vague

            def fit(problem: Problem, previous: Fitted | None, rough: bool, about: str) -> Fitted:
                tol = self._tolerance(data.source.n_rows)
                problem = replace(
                    problem,
                    solver=self._solver(problem.units.target_unit),
                    tol=max(tol, rough_tol(problem)) if rough else tol,
                )
                return fit_model(problem, rng, monitor.seen_as(about=about), previous)

            calibration = calibrate(data, problem, fit, rng, monitor)
            if calibration is None:
                fitted = fit(problem, None, False, "")
                self._set_posterior(data, problem, problem.spec, fitted)
            else:
                data, problem, fitted = calibration.data, calibration.problem, calibration.fitted
                self._set_posterior(data, problem, problem.spec, fitted, calibration.posterior)
            if vague.any():
                self.coef_prior_scale_[vague[0] if self.coef_prior_scale_.ndim == 1 else vague] = np.inf
            self._spec = problem.spec
            self.log_marginal_likelihood_value_ = fitted.lower_bound - self._counted_twice
            self.loss_curve_ = fitted.loss_curve
            self.n_iter_ = len(self.loss_curve_)
        self._warn((interrupted(self.n_iter_),) if monitor.interrupted else fitted.messages, problem.spec)
        if calibration is not None:
            calibration.warn()
        return self

    def _problem(self, data: Dataset) -> Problem:
        """Return the problem of a fit to a data set."""
        noise = as_noise(self.noise)
        if noise.heavy_tails or noise.inputs is not None:
            raise ValueError(f"The exact model has Gaussian noise of y only; got noise={self.noise!r}.")
        problem = Problem.from_data(
            data,
            kernel=self.kernel,
            coef_prior=as_coef_prior(self.coef_prior),
            noise=noise,
            normalize_y=self.normalize_y,
            allow_vague=True,
        )
        if self.n_targets not in (None, problem.n_outputs):
            raise ValueError(
                "The number of targets seen in `y` is different from the parameter `n_targets`. "
                f"Got {problem.n_outputs} != {self.n_targets}."
            )
        spec = problem.spec if self.optimizer is not None else problem.spec.as_given()
        if self.alpha is not None:
            if spec.starts.noise.value is not None:
                raise ValueError(
                    f"alpha={self.alpha!r} fixes the noise, but a WhiteKernel or Gaussian(variance=...) asks to learn "
                    "it. Pass one of them only."
                )
            spec = spec.with_noise(self.alpha, fixed=True)
        return replace(
            problem,
            spec=spec,
            placement=Placement("all rows", 0),
            sharing="kernel" if problem.per_output else "all",
            variant=Variant(orthogonal=self.discrepancy == "orthogonal"),
        )

    def _solver(self, target_unit: np.ndarray) -> Solver:
        if callable(self.optimizer):
            return UserOptimizer(self.optimizer, target_unit, self.n_restarts)
        return LBFGS(n_restarts=self.n_restarts)

    def _tolerance(self, n_rows: int) -> float:
        if isinstance(self.tol, str):
            return 1e-9 if n_rows <= _FEW_ROWS else 0.01
        return self.tol

    def _before_fit(self, X: Any) -> Self:
        """Return a copy that predicts from the prior, with maps that are fitted to X."""
        model = clone(self)
        model._validate_params()
        # An X that is not a table counts as one row here; scikit-learn's validation raises the error.
        n_rows = len(X) if isinstance(X, list | tuple) else np.shape(X)[0] if np.ndim(X) else 1
        data = Dataset.from_user(model, X, np.zeros((n_rows, self.n_targets or 1)))
        problem = model._problem(data)
        if problem.vague.any():
            raise NotFittedError(
                f"This {type(self).__name__} is not fitted yet. It predicts before a fit only if all scales of "
                "CoefPrior are finite."
            )
        rows, spec, prior = problem.units.rows(data.source), problem.spec.as_given(), problem.units.prior
        model.kernel_map_ = data.maps.kernel_map
        model._posterior = Posterior(prior_predictor(rows, spec, prior), replace(data.maps, shapes=problem.shapes))
        return model

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.requires_fit = False
        return tags

    def log_marginal_likelihood(
        self, theta: ArrayLike | None = None, eval_gradient: bool = False, clone_kernel: bool = True
    ) -> Any:
        """Return the log marginal likelihood of the training data under another kernel, with the fitted noise.

        The method corresponds to that of `GaussianProcessRegressor`. The result is in units of y, also with
        ``normalize_y``.

        Parameters
        ----------
        theta : array-like of shape (n_theta,) or (n_outputs, n_theta), default=None
            Logarithms of the free hyperparameters of each output, in the order of ``kernel_.theta``. A vector in the
            order of ``kernel.theta`` is accepted too. Then a missing signal variance is 1, and the noise is that of
            ``theta``. If None, the fitted hyperparameters are used.
        eval_gradient : bool, default=False
            Whether to return the gradient too. It needs a ``theta``.
        clone_kernel : bool, default=True
            Whether to keep ``kernel_``. If False, ``theta`` is stored in it, and predictions do not change.

        Returns
        -------
        log_likelihood : float
            Log marginal likelihood in nats, like ``log_marginal_likelihood_value_``.
        gradient : ndarray of the shape of ``theta``
            Gradient with respect to ``theta``. It is returned only if ``eval_gradient`` is True. Add up its rows for
            parameters that outputs share.

        Raises
        ------
        ValueError
            If ``theta`` has another shape or is out of range, or ``eval_gradient`` is set without it.
        """
        check_fitted(self)
        if theta is None and eval_gradient:
            raise ValueError("Gradient can only be evaluated for theta!=None: give theta=kernel_.theta.")
        if theta is None:
            return self.log_marginal_likelihood_value_
        predictor = self._fitted.at_mode.predictor()
        if predictor.shared:
            raise ValueError("log_marginal_likelihood(theta) does not support weights that outputs share.")
        order, given, width = self._spec.order, self._spec.given_order, np.shape(theta)[-1:]
        # Fitted hyperparameters of k̃, s² and σ² of each output, in the user's units.
        fitted = [
            np.append(group.hyperparameters, [predictor.signal[o], predictor.noise[o]])
            for o, group in enumerate(predictor.by_output)
        ]
        if clone_kernel and width == (len(given),) != (len(order),):
            order = given
            if self._spec.adds_signal:
                fitted = [np.append(numbers[:-2], [1.0, numbers[-1]]) for numbers in fitted]
        with single_threaded_libraries():
            value = value_at(theta, eval_gradient, order, fitted, self._log_likelihood_of)
        value = (value[0] - self._counted_twice, value[1]) if eval_gradient else value - self._counted_twice
        if not clone_kernel:
            kernels, thetas = np.atleast_1d(self.kernel_), np.atleast_2d(np.asarray(theta, dtype=np.float64))
            for kernel, theta_of_kernel in zip(kernels, thetas, strict=True):
                kernel.theta = theta_of_kernel
        return value

    def _log_likelihood_of(self, output: int, numbers: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log likelihood of an output at other numbers, and its gradient in their logarithms.

        ``numbers`` (n_hyper + 2,) are the hyperparameters of k̃, s² and σ², in the user's units. So is the value, in
        nats.
        """
        posterior, target_unit = self._fitted.at_mode.models[0].posterior, self._fitted.units.target_unit
        assert isinstance(posterior, ExactPosterior)
        exact, only, variance = posterior.exact, slice(output, output + 1), target_unit[output] ** 2
        kernel = exact.kernel if exact.kernels is None else exact.kernels[output]
        prior = exact.prior.at(posterior.values).outputs(only)
        *hyperparameters, signal, noise = numbers
        values = {
            "hyperparameters": np.array(hyperparameters),
            "signal": np.array([signal / variance]),
            "noise": np.array([noise / variance]),
        }
        of_output = ExactModel(kernel, prior, exact.vague[only], exact.rows.of(only))
        value, gradient = of_output.log_likelihood(values)
        shift = exact.n_contrasts[output] * np.log(target_unit[output])
        return value - float(shift), np.concatenate([gradient[name] for name in values])


# --- optimizers of the user -------------------------------------------------------------------------------------------

# Takes θ -> minus the log marginal likelihood, the first θ and bounds=. Returns the best θ and its value, as for GPR.
Optimizer = Callable[..., tuple[np.ndarray, float]]


class UserOptimizer(Solver):
    """A function of the user as a solver of the exact model. It sees logarithms in the user's units."""

    takes_any_objective = False
    takes_widest_limits = True

    def __init__(self, optimizer: Optimizer, target_unit: np.ndarray, n_restarts: int = 0):
        self.optimizer = optimizer
        self.target_unit = target_unit
        self.n_restarts = n_restarts

    def minimise(
        self,
        objective: LikelihoodObjective,
        start: np.ndarray,
        limits: Limits,
        max_iter: int,
        tolerance: Tolerance,
        monitor: Monitor,
        curvature: Any = None,
        metric: Any = None,
    ) -> Minimum:
        """Run the user's function. Arguments are those of `LBFGS.minimise`. It decides itself when it ends."""
        if len(start) == 0:
            return LBFGS().minimise(objective, start, limits, max_iter, tolerance, monitor)
        table, exact, (lower, upper) = objective.table, objective.model, limits
        n_rows, log_variance = exact.rows.total, 2.0 * np.log(self.target_unit)
        shift = float(exact.n_contrasts @ np.log(self.target_unit))
        in_users_units = table.flat(
            {
                parameter.name: log_variance
                if parameter.name in ("signal", "noise")
                else np.zeros(parameter.start.shape)
                for parameter in table.parameters
            }
        )
        best = Minimum(start, np.inf, converged=True)

        def of_theta(theta: np.ndarray, eval_gradient: bool = True) -> Any:
            theta = np.atleast_1d(np.asarray(theta, dtype=float))
            if theta.shape != start.shape:
                raise ValueError(f"theta must be {len(start)} numbers; got an array of shape {theta.shape}.")
            flat = theta - in_users_units
            try:
                loss, gradient = objective(flat)
            except NotPositiveDefiniteError:
                loss, gradient = np.inf, np.zeros(len(flat))
            if loss <= best.loss:
                best.x, best.loss = flat, loss
            best.loss_curve.append(loss)
            monitor.iteration(len(best.loss_curve), loss)
            value = n_rows * loss + shift
            return (value, n_rows * gradient) if eval_gradient else value

        with monitor.keeping_the_best():
            bounds = np.column_stack(limits) + in_users_units[:, np.newaxis]
            result = self.optimizer(of_theta, start + in_users_units, bounds=bounds)
            try:
                theta, _ = result
                theta = np.asarray(theta, dtype=float)
            except (TypeError, ValueError):
                theta = np.empty(0)
            if theta.shape != start.shape or not np.isfinite(theta).all():
                raise ValueError(f"optimizer must return {len(start)} finite numbers and their value; got {result!r}.")
            best.x = np.clip(theta - in_users_units, lower, upper)
            best.loss = objective(best.x)[0]
        return best


# --- functions of kernels ---------------------------------------------------------------------------------------------

# Maps (output, numbers) to a value, and its gradient in the logarithms of the numbers.
OfKernel = Callable[[int, np.ndarray], tuple[float, np.ndarray]]


def value_at(
    theta: ArrayLike, eval_gradient: bool, order: np.ndarray, fitted: Sequence[np.ndarray], of_kernel: OfKernel
) -> Any:
    """The sum over outputs of a function of kernels at theta and, optionally, its gradient, of the shape of theta.

    ``theta`` is (n_theta,) or, for several outputs, (o, n_theta). ``order`` (n_theta,) is the position of each entry in
    the numbers (`KernelSpec.order`). ``fitted`` has these numbers of each output (k̃'s hyperparameters, s², perhaps σ²)
    in the user's units: numbers that are not in theta stay. The value is -inf, as in scikit-learn's
    GaussianProcessRegressor, if the kernel matrix cannot be factorised. Raises a ValueError if theta has another shape
    or is out of range.
    """
    n_outputs, thetas = len(fitted), as_floats(theta, "theta")
    shape = (len(order),) if n_outputs == 1 else (n_outputs, len(order))
    if thetas.shape != shape:
        which = "" if n_outputs == 1 else " of each of the kernels"
        raise ValueError(f"theta must be of shape {shape}, as kernel_.theta{which}; got {thetas.shape}.")
    if not (np.abs(thetas) <= np.log(LARGEST)).all():
        raise ValueError(f"theta must be logarithms of numbers from {1 / LARGEST:g} to {LARGEST:g}; got {theta!r}.")
    total, gradient = 0.0, np.zeros((n_outputs, len(order)))
    for o, numbers_of_fit in enumerate(fitted):
        numbers = numbers_of_fit.copy()
        numbers[order] = np.exp(thetas.reshape(gradient.shape)[o])
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                value, bars = of_kernel(o, numbers)
        except NotPositiveDefiniteError:
            return (-np.inf, np.zeros(shape)) if eval_gradient else -np.inf
        total += value
        gradient[o] = bars[order]
    return (total, gradient.reshape(shape)) if eval_gradient else total

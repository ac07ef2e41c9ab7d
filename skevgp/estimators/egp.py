"""EGPRegressor: explicit physics features plus an exact Gaussian process."""

from __future__ import annotations

from collections.abc import Callable
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
from ..fitting.exact import ExactFit, fit_exact, value_at
from ..fitting.messages import interrupted
from ..fitting.prior import CoefPrior, as_coef_prior
from ..fitting.problem import Problem
from ..fitting.start import prior_predictor
from ..noise import Gaussian, as_noise
from ..utils.monitor import monitor_of
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.validation import check_fitted, is_dask, unchanged_if_it_fails
from .base import GaussianProcess, names_moved_arguments

# Of so many, an iteration takes a few milliseconds at most.
_FEW_ROWS = 100


class EGPRegressor(GaussianProcess):
    r"""Exact Gaussian process with explicit features (EGP).

    The model of each output is that of `EVGPRegressor`,

    .. math:: y = h(x)^\top \beta + f(x) + \varepsilon, \quad \beta \sim N(\mu_\beta, \Sigma_\beta), \quad
              f \sim GP(0, k), \quad \varepsilon \sim N(0, \sigma^2),

    but nothing is approximated: kernel and noise maximise the log marginal likelihood with the weights integrated out.
    Time is cubic in the number of rows and memory quadratic: for a few thousand rows, and as the reference.

    Parameters
    ----------
    feature_map : transformer, default=None
        x -> h(x), for example `InertiaForceGravity("pendulum")`. It sees X as given: do not scale columns in front of
        it. None has no explicit features. It may return a row for each output, (n, n_outputs, n_h).
    kernel : sklearn.gaussian_process.kernels.Kernel or callable, default=None
        Covariance of f, as of `EVGPRegressor`; outputs share its shape, and have signal variances of their own. Of
        outputs that vary along different columns, or at different scales, it can learn one at the cost of the others:
        ``MultiOutputRegressor(EGPRegressor(...))`` of scikit-learn fits each by itself (its predictions have no std).
    kernel_map : transformer, default=None
        x -> the kernel's inputs, for example a `StandardScaler`. Only the kernel sees it: scaling belongs here.
        It may return a row for each output, (n, n_outputs, d).
    coef_prior : skevgp.CoefPrior or "auto", default="auto"
        Prior of the weights β. ``"auto"`` asks the feature map. ``CoefPrior(scale=np.inf)`` says that nothing is known
        of the weights before.
    noise : "gaussian" or `skevgp.noise.Gaussian`, default="gaussian"
        Model of the noise. ``Gaussian(variance=...)`` is where its variance starts.
    alpha : float, default=None
        A noise variance that is known, in place of one that is learned; ``std`` has it. If each row has its own, give
        their mean here, and to `fit` what they are in units of it, ``relative_variance``.
    normalize_y : bool, default=False
        Whether the prior mean is the training mean of y, in place of 0. Of a y that is then constant nothing is known
        but the constant: its signal stays at a standard deviation of 1.
    optimizer : "fmin_l_bfgs_b", callable or None, default="fmin_l_bfgs_b"
        What finds kernel and noise. None takes the kernel as it is given: a signal variance that is added to one that
        has none is 1, as all numbers of the default kernel are. A callable is one as `GaussianProcessRegressor` takes,
        ``optimizer(objective, theta, bounds=bounds) -> (theta, value)``, called from each start: the objective is minus
        the log marginal likelihood, ``objective(theta, eval_gradient=True) -> (value, gradient)``; theta (n_free,) are
        the logarithms of k̃'s free hyperparameters, then of each output's signal variance, then of each one's noise
        variance; bounds (n_free, 2) are those of its entries.
    max_iter : int, default=1000
        The most iterations of L-BFGS from each start. With 0 kernel and noise stay where they start.
    max_time : float, default=None
        Seconds that the iterations may take; when they are over, the best so far is kept, with a ConvergenceWarning.
    n_restarts : int, default=0
        Further fits with kernel and noise drawn log-uniformly around the first start, within their bounds; the
        likeliest is kept.
    tol : float or "auto", default="auto"
        In nats. L-BFGS starts anew from its best point when each of three iterations in a row raises the log marginal
        likelihood by less than this, and stops when a fresh start gains no more. ``"auto"`` is 0.01, and 1e-9 for 100
        rows or fewer, where iterations cost next to nothing: a function without noise is then met to rounding.
    n_targets : int, default=None
        How many outputs y has. It is needed before a fit only, when `predict` and `sample_y` are of the prior; None is
        one there.
    random_state : int, RandomState instance or None, default=None
        Draws the restarts.
    verbose : int, default=0
        Progress messages, as in `EVGPRegressor`. The bound is the log marginal likelihood.

    Attributes
    ----------
    coef_ : ndarray of shape (n_h,) or (n_outputs, n_h)
        Posterior mean of the weights. Only with a ``feature_map``. It is per feature of the map, not per column of X:
        where scikit-learn ranks columns (`SelectFromModel`, `RFE`), give it for example ``importance_getter=lambda
        model: 1 / model.kernel_.k2.length_scale``, for one output, the default kernel and columns of like scale. A y
        of shape (n_samples, 1) is one output, as of shape (n_samples,): nothing has an axis of outputs then.
    coef_std_ : ndarray of shape (n_h,) or (n_outputs, n_h)
        Their posterior standard deviations. Only with a ``feature_map``.
    coef_cov_ : ndarray of shape (n_h, n_h) or (n_outputs, n_h, n_h)
        Their posterior covariances. Only with a ``feature_map``.
    coef_names_ : ndarray of str of shape (n_h,)
        What the feature map calls them, by its ``get_feature_names_out``; h0, h1, ... if it does not say. Only with a
        ``feature_map``.
    coef_prior_mean_, coef_prior_scale_ : ndarray of the shape of ``coef_``
        The prior that was used. Only with a ``feature_map``.
    feature_map_, kernel_map_ : transformer or None
        Fitted clones of the maps.
    kernel_ : Kernel, or list of Kernel for several outputs
        Fitted, without the noise.
    noise_variance_ : float or ndarray of shape (n_outputs,)
        σ², in squared units of y.
    log_marginal_likelihood_value_ : float
        In nats, summed over outputs. With k vague weights it is that of n_samples - k contrasts (eq. 2.45 there).
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the log marginal likelihood per iteration.
    n_iter_ : int
        Iterations of the start that was kept; of a callable ``optimizer`` its evaluations.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    EVGPRegressor : The same model with inducing points, for any number of rows.

    References
    ----------
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, section 2.7.

    Examples
    --------
    A wave on a linear trend of which nothing is known; the explicit features are x and 1:

    >>> import numpy as np
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import CoefPrior, EGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=np.inf)).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 2)
    0.96

    Before a fit predictions are of the prior, where y counts as of size one (maps are fitted to the rows that are asked
    for: with scalers among them, rows are relative to each other):

    >>> prior = EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=[0.0, 2.0]))
    >>> mean, std = prior.predict([[0.0], [3.0]], return_std=True)
    >>> std.round(2)
    array([1.  , 6.08])
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "feature_map": "no_validation",
        "kernel": "no_validation",
        "kernel_map": "no_validation",
        "coef_prior": "no_validation",
        "noise": "no_validation",
        "alpha": [Interval(Real, 0, None, closed="neither"), None],
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

    _fitted: ExactFit

    @names_moved_arguments
    def __init__(
        self,
        feature_map: TransformerMixin | None = None,
        kernel: Kernel | Callable[..., Any] | None = None,
        *,
        kernel_map: TransformerMixin | None = None,
        coef_prior: CoefPrior | Literal["auto"] = "auto",
        noise: Literal["gaussian"] | Gaussian = "gaussian",
        alpha: float | None = None,
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
        """Fit kernel and noise; the posterior is exact.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers up to 1e100. The maps see it as it is given: a data frame (pandas, polars, pyarrow) stays one, and
            with a ``kernel_map`` it may hold what is no number, such as words that the maps encode.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Numbers up to 1e100; the largest of a column 0 or above 1e-140.
        sample_weight, relative_variance : array-like of shape (n_samples,), default=None
            As of `EVGPRegressor.fit`.

        Returns
        -------
        self : EGPRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, shapes do not fit, or features with vague
            weights depend on each other; the message names the argument, the value and what is allowed.

        Warns
        -----
        ConvergenceWarning
            If iterations or time were used up, rounding errors ended them, or Ctrl-C did (the best parameters so far
            are kept); if the Gaussian process learned nothing; if y is far from its prior mean; if a parameter of the
            given kernel ended at one of its bounds. It says what to change.
        """
        if is_dask(X):
            raise TypeError("X is a Dask array, but the exact model needs all rows at once: use EVGPRegressor.")
        progress = monitor_of(self.verbose, max_time=self.max_time)
        with unchanged_if_it_fails(self), single_threaded_libraries(), progress as monitor:
            data = Dataset.from_user(self, X, y, sample_weight, relative_variance)
            problem = self._problem(data)
            fitted = fit_exact(
                replace(problem, max_iter=0 if self.optimizer is None else self.max_iter),
                check_random_state(self.random_state),
                monitor,
                self.n_restarts,
                self._tolerance(data.source.n_rows),
                self.optimizer if callable(self.optimizer) else None,
            )
            self._set_posterior(data, problem, problem.spec, fitted)
            if problem.vague.any():
                self.coef_prior_scale_[problem.vague[0] if self.coef_prior_scale_.ndim == 1 else problem.vague] = np.inf
            self._spec = problem.spec
            self.log_marginal_likelihood_value_ = fitted.log_marginal_likelihood
            self.loss_curve_ = fitted.loss_curve
            self.n_iter_ = len(self.loss_curve_)
        self._warn((interrupted(self.n_iter_),) if monitor.interrupted else fitted.messages, problem.spec)
        return self

    def _problem(self, data: Dataset) -> Problem:
        """What a fit to a data set starts from."""
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
                    f"alpha={self.alpha!r} is the noise, but a WhiteKernel or Gaussian(variance=...) says that it is "
                    "to be learned; give one of them."
                )
            spec = spec.with_noise(self.alpha, fixed=True)
        return replace(problem, spec=spec)

    def _tolerance(self, n_rows: int) -> float:
        if isinstance(self.tol, str):
            return 1e-9 if n_rows <= _FEW_ROWS else 0.01
        return self.tol

    def _before_fit(self, X: Any) -> Self:
        """A copy that predicts what is known without data. Its maps are fitted to X."""
        model = clone(self)
        model._validate_params()
        # What is no table has one row, until it is refused in scikit-learn's words.
        n_rows = len(X) if isinstance(X, list | tuple) else np.shape(X)[0] if np.ndim(X) else 1
        data = Dataset.from_user(model, X, np.zeros((n_rows, self.n_targets or 1)))
        problem = model._problem(data)
        if problem.vague.any():
            raise NotFittedError(
                f"This {type(self).__name__} is not fitted yet, and with an infinite scale of CoefPrior nothing is "
                "known before."
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
        """Log marginal likelihood of the training data under another kernel, with the fitted noise.

        As of `GaussianProcessRegressor`, but always in the units of y, and with ``normalize_y`` too.

        Parameters
        ----------
        theta : array-like of shape (n_theta,) or (n_outputs, n_theta), default=None
            Logarithms of the free hyperparameters, in the order of ``kernel_.theta``; for several outputs those of each
            one's kernel, which need not agree in what the fitted ones share. None means the fitted ones. Where it is of
            another length, ``kernel.theta`` will do, of the kernel as it was given: a signal variance that it does not
            have is then 1, and noise that it has is its own.
        eval_gradient : bool, default=False
            Whether to return the gradient too; only with a ``theta``.
        clone_kernel : bool, default=True
            Whether ``kernel_`` is left as it is; if not, ``theta`` stays in it, and predictions do not change.

        Returns
        -------
        log_likelihood : float
            In nats, summed over outputs; with vague weights, of contrasts, as ``log_marginal_likelihood_value_``.
        gradient : ndarray of the shape of ``theta``
            If ``eval_gradient``. For what outputs share add up its rows.

        Raises
        ------
        ValueError
            If ``theta`` has another shape or is out of range, or a gradient is asked for without it.
        """
        check_fitted(self)
        if theta is None and eval_gradient:
            raise ValueError("Gradient can only be evaluated for theta!=None: give theta=kernel_.theta.")
        if theta is None:
            return self.log_marginal_likelihood_value_
        predictor = self._posterior.predictor
        if predictor.shared:
            raise ValueError("log_marginal_likelihood(theta) needs outputs with weights of their own: not shared ones.")
        order, given, width = self._spec.order, self._spec.given_order, np.shape(theta)[-1:]
        # Of each output k̃'s hyperparameters, s² and σ², as fitted, in the user's units.
        fitted = [
            np.append(group.hyperparameters, [predictor.signal[o], predictor.noise[o]])
            for o, group in enumerate(predictor.by_output)
        ]
        if clone_kernel and width == (len(given),) != (len(order),):
            order = given
            if self._spec.adds_signal:
                fitted = [np.append(own[:-2], [1.0, own[-1]]) for own in fitted]
        with single_threaded_libraries():
            found = value_at(theta, eval_gradient, order, fitted, self._fitted.log_likelihood_at)
        if not clone_kernel:
            kernels, thetas = np.atleast_1d(self.kernel_), np.atleast_2d(np.asarray(theta, dtype=np.float64))
            for kernel, own in zip(kernels, thetas, strict=True):
                kernel.theta = own
        return found

"""EVGPRegressor: explicit physics features plus a sparse variational Gaussian process."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin
from sklearn.gaussian_process.kernels import Kernel
from sklearn.utils import check_random_state

from ..data.threads import single_threaded_libraries
from ..exceptions import DependentRowsWarning, warn_user
from ..fitting.advice import DEPENDENT_ROWS, interrupted
from ..fitting.outputs import fit_outputs
from ..fitting.plan import Sharing
from ..fitting.sharing import with_groups
from ..solvers.solvers import LBFGS, Adam, check_weights, resolved
from ..utils.monitor import monitor_of
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.validation import check_integer, unchanged_if_it_fails
from .sparse import SparseGaussianProcess


class EVGPRegressor(SparseGaussianProcess):
    r"""Sparse variational Gaussian process with explicit features (EVGP).

    The model of each output is

    .. math:: y = h(x)^\top \beta + f(x) + \varepsilon, \quad \beta \sim N(\mu_\beta, \Sigma_\beta), \quad
              f \sim GP(0, k), \quad \varepsilon \sim N(0, \sigma^2),

    where the features h say what is known (rough physics, a trend) and f, a Gaussian process with ``n_inducing``
    inducing points, learns the rest. Time is linear in the number of rows. Without a feature map it is the sparse
    Gaussian process of Titsias (2009) and Hensman et al. (2013).

    Parameters
    ----------
    feature_map : transformer, default=None
        x -> h(x), for example `InertiaForceGravity("pendulum")`, of X as given: do not scale its columns. None: none.
        It may return a row for each output, (n, n_outputs, n_h), as the regressor matrix of a robot's torques.
    kernel : sklearn.gaussian_process.kernels.Kernel or callable, default=None
        Covariance of f: one of the kernels that `skevgp.kernels` lists, or sums and products of them; a WhiteKernel as
        a term of the outermost sum sets the noise. Starts, bounds and ``"fixed"`` are respected. The outermost constant
        factor is the signal variance, which each output has of its own; if there is none, one is put in front, with its
        start and bounds from the data. A callable is a covariance function in autograd.numpy, as of a `FunctionKernel`.
        None is an RBF with a length scale per column, all starts and bounds taken from the data.
    kernel_map : transformer, default=None
        x -> the kernel's inputs, for example a `StandardScaler`. Only the kernel sees it: scaling belongs here.
        It may return a row for each output, (n, n_outputs, d): the kernel of output j then sees row j.
    n_inducing : int or "auto", default=100
        Inducing points; fewer if there are fewer distinct rows. ``"auto"``, for L-BFGS, begins with 10 (or those of
        ``inducing_init``; in a warm start those of the last fit) and adds half as many again until that raises the
        bound by less than 0.01 nats per row and output, and no better kernel is known: up to 1,000 rows are fitted
        exactly, for few points can hide what there is to learn.
    max_inducing : int, default=1000
        The most that ``n_inducing="auto"`` adds points up to.
    inducing_init : {"auto", "k-means", "greedy"} or array-like of shape (m, d), default="auto"
        Where inducing points start. ``"k-means"``: at cluster centres of the kernel's inputs. ``"greedy"``: one after
        the other at the row that the kernel, as it starts, knows least from those before (Burt et al. 2020).
        ``"auto"``: at cluster centres, and with L-BFGS after 25 iterations once more, greedily under the kernel
        learned so far; 25 iterations later the better of the two fits goes on (``loss_curve_`` jumps where points are
        placed). They are not placed anew with ``max_iter`` up to 25, a kernel that is fixed, or a warm start. Or at
        given points in the space of ``kernel_map``, whose number then replaces ``n_inducing`` (with ``"auto"``, more
        are added). With ``max_iter=0``, or where they are all rows (and ``posterior="full"``), they stay where they
        start.
    sharing : {"auto", "all", "kernel", "none"} or list of list of int, default="auto"
        What the outputs share: inducing points and kernel shape (``"all"``, the fastest), the kernel's shape only
        (``"kernel"``, the paper's), or nothing. Groups, as ``[[0, 1], [2, 3]]``, share as ``"all"`` inside, and nothing
        with each other. ``"auto"`` finds them by short fits to up to 1,000 rows: on these it costs no output more than
        1 % of what its own Gaussian process gains, in nats, over features and noise; each group takes about the time of
        ``"all"``. Signal variance and noise are always per output, and so are
        weights but for ``share_coef``. Where a map returns a row for each output, ``"auto"`` is ``"none"``.
    posterior : {"full", "diagonal"}, default="full"
        q as one joint Gaussian of inducing values and weights, or the paper's, diagonal in both.
    coef_mean, coef_scale : array-like of shape (n_outputs, n_h), float or "auto", default="auto"
        Prior mean and standard deviation of the weights. ``"auto"`` asks the feature map's ``coef_prior(n_outputs)``;
        for a map without one, mean 0 and scale 10 * std(y) / rms(h). Scale 0 keeps a weight at its mean. If y is far
        from 0 compared with its scatter, an intercept among the features needs a wider scale than that, or
        ``normalize_y=True``.
    coef_cov : array-like of shape (n_h, n_h) or (n_outputs, n_h, n_h), default=None
        Prior covariance of the weights, of all outputs or of each, in place of ``coef_scale``: a link's mass and its
        first moment are correlated in any honest prior. ``coef_prior`` of a feature map may return one as its second
        array, of shape (n_outputs, n_h, n_h) or (n_h, n_h); where that would be the shape of a scale too, it is one.
    share_coef : bool or "auto", default="auto"
        Whether all outputs have the same weights, as torques of a robot's joints have one set of inertial parameters:
        then ``coef_mean``, ``coef_scale`` and what ``coef_prior`` returns have no axis of outputs, and outputs depend
        on each other (``predict(X, return_cov="joint")``, `sample_y`). ``"auto"``: if the fitted ``feature_map`` has
        an attribute ``share_coef`` that is true (a pipeline's last step, all parts of a union). Each output keeps its
        own f, noise and kernel (by ``sharing``), and all are fitted together; with ``solver="adam"`` or
        ``posterior="diagonal"`` it is an error, as are correlations.
    noise : {"gaussian", "student-t"}, default="gaussian"
        ``"student-t"``: with a Student-t's tails, for rows of which a few are wrong (a collision, a sensor's glitch).
        Rows off by more than about six standard deviations are outliers, whose noise is a Student-t with 4 degrees of
        freedom, thirty times as wide; the others' is Gaussian. A row is doubted as a whole by the outputs that are
        fitted together, and ``weights_`` says how much it still counts; kernel, noise and doubts take turns. ``std``
        and ``noise_variance_`` are those of rows that are no outliers, and no ``upper_bound_`` is known (inf). With
        L-BFGS only, not for Dask arrays; `partial_fit` doubts new rows, and leaves what was doubted before. Memory
        grows with the rows: by some ten numbers for each during the fit, and then by one (not in pickles) and
        ``weights_``.
    input_noise : float or array-like of shape (n_features,) or (n_features, n_features), default=None
        Standard deviations, or the covariance, of noise in X itself: to first order a row's noise variance is then σ² +
        ∂g Σ ∂gᵀ (McHutchon & Rasmussen 2011), the mean of outputs fitted together. Fits follow each other until σ²
        settles; it and ``std`` are of rows that are known exactly. Not for Dask arrays, Adam or Student-t noise.
    noise_variance : float, default=None
        Where the noise variance starts; None takes it from the data.
    noise_cv : int, default=5
        Folds, 2 or more: whole ``groups`` of `fit`, else random. After the iterations each is predicted from the others
        (Rasmussen & Williams 2006, section 5.4.2), with kernel shape and inducing points as they are, and signal and
        noise variance of each output are where log density and, half as much, the logarithm of the rms error are best,
        within their bounds. (The bound takes what inducing points cannot represent for noise: ``std`` of rows of a
        table is then too large. And it takes rows of a trajectory for independent: on new ones ``std`` is too small.)
        Up to 2,000 rows are predicted, and random folds are of 50,000 rows at most; it takes a few passes over these,
        and memory for a few times as many matrices (m + n_h, m + n_h) as folds. With hundreds of features it takes
        longer than 20 iterations. q is then at its optimum, after Adam too. It is left out
        with None, with ``max_iter=0``, of fewer than 50 rows, with inducing points at all rows and no ``groups`` (the
        model is then the exact one), and when a fit is interrupted or out of time;
        `partial_fit` keeps what the first call found.
    normalize_y : bool, default=False
        Whether the prior mean is the training mean of y, in place of 0. Of a y that is then constant nothing is known
        but the constant: its signal stays at a standard deviation of 1.
    solver : {"lbfgs", "adam"}, `skevgp.solvers.LBFGS` or `skevgp.solvers.Adam`, default="lbfgs"
        L-BFGS on the bound with q at its optimum, or the paper's Adam on mini-batches over all parameters, those of q
        among them. The strings are the solvers with their defaults; what only one of them understands is said there:
        ``Adam(batch_size=1000)``, ``LBFGS(n_restarts=2)``, and ``solver__batch_size`` in a grid search.
    max_iter : int, default=None
        The most iterations of L-BFGS, on all rows and on each sample of them, or steps of Adam; None means 1000 or
        16000. With 0 nothing is optimised: kernel and inducing points stay where they start, and q is at its optimum.
        Those on the way to the number of points of ``n_inducing="auto"``, up to 60 for each number, do not count.
    max_time : float, default=None
        Seconds until iterations end, those of each independent model when its share is over: the best so far is kept,
        with a ConvergenceWarning, and ``noise_cv`` left out. Half of them is the most for finding groups
        (``sharing="auto"``; if it is not enough, all outputs share). The passes before and after are not cut short.
    tol : float or "auto", default="auto"
        In nats. L-BFGS starts anew from its best point when each of three iterations in a row raises the bound by less
        than this, and stops when a fresh start gains no more. ``"auto"`` is 0.0015 % of what the fit has gained over
        features and noise alone, and at least 0.01. Adam goes over to its last steps, as many as before, when the loss
        stays flat: when its median over the last third of the steps differs from that over the third before by less
        than this (``"auto"``: 0.01), or by no more than chance, which mostly decides.
    forgetting_factor : float, default=1.0
        What the log likelihood of the rows seen so far is multiplied by at each `partial_fit`, in (0, 1]: 1 remembers
        all of them, 0.99 those of about the last hundred calls (exponential forgetting, for a system that drifts).
    warm_start : bool, default=False
        Whether to start from the last fit's kernel, noise and inducing points, and groups it found, where shapes agree.
    n_jobs : int, default=None
        Threads; None means 1, -1 all cores. The result does not depend on it.
    random_state : int, RandomState instance or None, default=None
        Places inducing points, draws mini-batches and restarts.
    verbose : int, default=0
        Verbosity. 0 prints nothing. 1 shows the rows that are fitted, the iteration, the bound and the seconds so far:
        in one live line if tqdm is installed and the output is a terminal or a notebook, else in a line every ten
        seconds. 2 prints a line at each iteration.

    Attributes
    ----------
    coef_, coef_std_ : ndarray of shape (n_h,) or (n_outputs, n_h)
        Posterior means and standard deviations of the weights. Only with a ``feature_map``: they are per feature of
        it, not per column of X. Where scikit-learn ranks columns (`SelectFromModel`, `RFE`), give it for example
        ``importance_getter=lambda model: 1 / model.kernel_.k2.length_scale``, for one output, the default kernel and
        columns of like scale. A y of shape (n_samples, 1) is one output, as of shape (n_samples,): nothing has an axis
        of outputs then.
    coef_cov_ : ndarray of shape (n_h, n_h) or (n_outputs, n_h, n_h)
        Their posterior covariances. Only with a ``feature_map``. (Where outputs share their weights, nothing of them
        has an axis of outputs.)
    coef_names_ : ndarray of str of shape (n_h,)
        What the feature map calls them, by its ``get_feature_names_out``; h0, h1, ... if it does not say. Only with a
        ``feature_map``.
    coef_prior_mean_, coef_prior_scale_ : ndarray of the shape of ``coef_``
        The prior that was used. Only with a ``feature_map``.
    feature_map_, kernel_map_ : transformer or None
        Fitted clones of the maps.
    inducing_points_ : ndarray of shape (m, d) or, for several outputs unless all share them, (n_outputs, m, d)
        In the space of ``kernel_map``. A list of arrays where ``n_inducing="auto"`` found other numbers for other
        outputs, which share nothing.
    sharing_ : list of list of int
        The outputs of each independent model: groups, all outputs (``"all"`` and ``"kernel"``) or single ones.
    kernel_ : Kernel, or list of Kernel for several outputs
        Fitted, without the noise: ``GaussianProcessRegressor(kernel=m.kernel_, alpha=m.noise_variance_,
        optimizer=None)`` is the exact counterpart.
    noise_variance_ : float or ndarray of shape (n_outputs,)
        σ², in squared units of y.
    weights_ : ndarray of shape (n_samples,) or (n_samples, n_outputs)
        Only with ``noise="student-t"``: the expected τ of each row, by which its noise variance is divided: 1 for an
        ordinary row, near 0 for one that is doubted; NaN for one of weight 0. After `partial_fit`, of the new rows.
    lower_bound_, upper_bound_ : float
        On the log marginal likelihood at the fitted parameters; nats, summed over outputs; good to a few nats where
        features are alike to 1e-9. Where they agree, points cost nothing. The upper one (Titsias 2014) holds for either
        posterior, loose with many rows. With ``noise_cv`` the lower one is below the last iteration's: noise has moved.
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the bound per iteration on all rows (of Adam: a mini-batch's estimate; of a fit that was interrupted on a
        sample of the rows: the sample's, times the number of rows over its size).
    n_iter_ : int
        Iterations of the start that was kept (a fit whose noise comes to explain everything is tried from others).
    n_parameters_ : int
        Parameters of kernel, noise and inducing points that are not fixed, and all of q.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    EGPRegressor : The same model without inducing points, exact, for a few thousand rows.
    sklearn.gaussian_process.GaussianProcessRegressor : The exact GP without features.

    References
    ----------
    - D. L. Marino, M. Manic (2020): Physics Enhanced Data-Driven Models with Variational Gaussian Processes.
    - M. K. Titsias (2009): Variational Learning of Inducing Variables in Sparse Gaussian Processes.
    - M. K. Titsias (2014): Variational Inference for Gaussian and Determinantal Point Processes.
    - J. Hensman, N. Fusi, N. D. Lawrence (2013): Gaussian Processes for Big Data.
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, section 2.7.
    - M. E. Tipping, N. D. Lawrence (2005): Variational Inference for Student-t Models.
    - P. Jylänki, J. Vanhatalo, A. Vehtari (2011): Robust Gaussian Process Regression with a Student-t Likelihood.

    Examples
    --------
    A wave on a linear trend; the explicit features are x and 1:

    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(PolynomialFeatures(1), n_inducing=10, random_state=0).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 2)
    0.96

    Gravity's torque in two joints is linear in the same two first moments, 20 and 5; each joint has a row of features:

    >>> import numpy as np
    >>> from sklearn.preprocessing import FunctionTransformer
    >>> def gravity(X):
    ...     own, both = np.sin(X[:, 0]), np.sin(X[:, 0] + X[:, 1])
    ...     return np.stack([np.column_stack([own, both]), np.column_stack([0.0 * own, both])], axis=1)
    >>> X = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    >>> y = gravity(X) @ [20.0, 5.0] + np.cos(2.0 * X)
    >>> model = EVGPRegressor(FunctionTransformer(gravity), share_coef=True, n_inducing=20, random_state=0).fit(X, y)
    >>> model.coef_.round(1)
    array([20.,  5.])
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **SparseGaussianProcess._parameter_constraints,
        "n_inducing": [Interval(Integral, 1, None, closed="left"), StrOptions({"auto"})],
        "max_inducing": [Interval(Integral, 1, None, closed="left")],
        "inducing_init": [StrOptions({"auto", "k-means", "greedy"}), "array-like"],
        "sharing": [StrOptions({"all", "kernel", "none", "auto"}), "array-like"],
        "posterior": [StrOptions({"full", "diagonal"})],
        "noise": [StrOptions({"gaussian", "student-t"})],
        "noise_cv": [Interval(Integral, 2, None, closed="left"), None],
        "input_noise": ["array-like", Real, None],
        "solver": "no_validation",
        "max_iter": [Interval(Integral, 0, None, closed="left"), None],
        "tol": [StrOptions({"auto"}), Interval(Real, 0, None, closed="left")],
        "forgetting_factor": [Interval(Real, 0, 1, closed="right")],
        "warm_start": ["boolean"],
        "n_jobs": [Integral, None],
    }

    def __init__(
        self,
        feature_map: TransformerMixin | None = None,
        kernel: Kernel | Callable[..., Any] | None = None,
        *,
        kernel_map: TransformerMixin | None = None,
        n_inducing: int | Literal["auto"] = 100,
        max_inducing: int = 1000,
        inducing_init: Literal["auto", "k-means", "greedy"] | ArrayLike = "auto",
        sharing: Sharing = "auto",
        posterior: Literal["full", "diagonal"] = "full",
        coef_mean: ArrayLike | Literal["auto"] = "auto",
        coef_scale: ArrayLike | Literal["auto"] = "auto",
        coef_cov: ArrayLike | None = None,
        share_coef: bool | Literal["auto"] = "auto",
        noise: Literal["gaussian", "student-t"] = "gaussian",
        input_noise: ArrayLike | None = None,
        noise_variance: float | None = None,
        noise_cv: int | None = 5,
        normalize_y: bool = False,
        solver: Literal["lbfgs", "adam"] | LBFGS | Adam = "lbfgs",
        max_iter: int | None = None,
        max_time: float | None = None,
        tol: float | Literal["auto"] = "auto",
        forgetting_factor: float = 1.0,
        warm_start: bool = False,
        n_jobs: int | None = None,
        random_state: int | np.random.RandomState | None = None,
        verbose: int = 0,
    ):
        self.feature_map = feature_map
        self.kernel = kernel
        self.kernel_map = kernel_map
        self.n_inducing = n_inducing
        self.max_inducing = max_inducing
        self.inducing_init = inducing_init
        self.sharing = sharing
        self.posterior = posterior
        self.coef_mean = coef_mean
        self.coef_scale = coef_scale
        self.coef_cov = coef_cov
        self.share_coef = share_coef
        self.noise = noise
        self.input_noise = input_noise
        self.noise_variance = noise_variance
        self.noise_cv = noise_cv
        self.normalize_y = normalize_y
        self.solver = solver
        self.max_iter = max_iter
        self.max_time = max_time
        self.tol = tol
        self.forgetting_factor = forgetting_factor
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
            Numbers up to 1e100. The maps see it as it is given: a data frame (pandas, polars, pyarrow) stays one, and
            with a ``kernel_map`` it may hold what is no number, such as words that the maps encode. Memory-mapped
            arrays of float64 or float32 are not copied. Chunks of a Dask array stay on their workers, and the maps see
            chunks: they are fitted by ``partial_fit`` where they have it, else to 10,000 rows spread over X.
            Without a ``dask.distributed.Client`` chunks are read anew at each pass.
        y : array-like or dask.array.Array of shape (n_samples,) or (n_samples, n_outputs)
            Numbers up to 1e100; the largest of a column 0 or above 1e-140.
        sample_weight : array-like or dask.array.Array of shape (n_samples,), default=None
            What each row's log likelihood is multiplied by: 0 removes the row (before the maps are fitted, but to a
            Dask array's chunks), 2 is the row twice. Maps whose ``fit`` has a ``sample_weight`` are given it.
        groups : array-like of shape (n_samples,), default=None
            Which rows belong together, by any labels: for rows of trajectories their numbers, such as
            ``make_dynamics(...).groups``. ``noise_cv`` then leaves out whole groups, so that ``std`` is that of new
            ones; where half of the rows or more are of one group, blocks of rows that follow each other inside a group.
            None: rows are independent, and folds random.
        relative_variance : array-like or dask.array.Array of shape (n_samples,), default=None
            Known differences between the rows' noise: its variance is σ² times this number, the same of all outputs.
            With σ² fixed at 1, by ``WhiteKernel(1, "fixed")``, it is the ``alpha`` of GaussianProcessRegressor.

        Returns
        -------
        self : EVGPRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, or shapes do not fit; the message names the
            argument, the value and what is allowed.
        KeyboardInterrupt
            Upon Ctrl-C before there is anything to keep, as while ``sharing="auto"`` looks for groups.

        Warns
        -----
        ConvergenceWarning
            If iterations or time were used up, rounding errors or Ctrl-C ended them (the best parameters so far are
            kept); if the Gaussian process learned nothing, or nothing that holds for groups left out, y is far from its
            prior mean, or a parameter of the given kernel ended at a bound of it. It says what to change.
        skevgp.exceptions.DependentRowsWarning
            If rows near each other, in the order given, are so alike that the noise would be more than four times as
            large if blocks of them were left out, or rows follow a path (two directions of the kernel's inputs change
            slowly, and none is sorted) and their log density would be lower by 0.1: ``groups`` should say which belong
            together.
        """
        solver = resolved(self.solver, self.posterior)
        if not isinstance(self.n_inducing, str):
            check_integer(self.n_inducing, "n_inducing", minimum=1)
        if isinstance(self.n_inducing, str) and isinstance(solver, Adam):
            raise ValueError(f'n_inducing="auto" needs solver="lbfgs" or an LBFGS(...); got solver={self.solver!r}.')
        self._check_noise(solver, X)
        progress = monitor_of(self.verbose, solver.callback, self.max_time)
        with unchanged_if_it_fails(self), single_threaded_libraries(), progress as monitor:
            problem = self._problem(X, y, sample_weight, relative_variance, groups)
            self._training_data = problem.data
            request = self._request(problem, solver)
            check_weights(solver, self.posterior, problem.units.prior, self.sharing, problem.per_output)
            previous = getattr(self, "_fitted", None) if self.warm_start else None
            rng = check_random_state(self.random_state)
            request = with_groups(request, rng, monitor, previous)
            self._fitted = fit_outputs(request, rng, monitor, previous)
            if self.input_noise is not None:
                self._fitted = self._with_noisy_inputs(request, rng, monitor)
            self._set_attributes()
            self._set_weights(problem.data[-1])
        self._warn_of((interrupted(self.n_iter_),) if monitor.interrupted else self._fitted.messages)
        if self._fitted.dependent:
            warn_user(DEPENDENT_ROWS, DependentRowsWarning)
        return self

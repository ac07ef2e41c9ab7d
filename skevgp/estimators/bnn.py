"""BayesianMLPRegressor: a neural network whose weights are uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from ..data.threads import single_threaded_libraries
from ..data.weights import chosen_rows, rows_of
from ..exceptions import warn_user
from ..utils.monitor import monitor_of
from ..utils.shapes import like_y
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.state import StatefulEstimator
from ..utils.validation import (
    as_floats,
    check_integer,
    check_magnitude,
    check_size,
    is_plain,
    unchanged_if_it_fails,
    validate_numbers,
)
from .bnn_model import VariationalNetwork
from .bnn_training import Scaling, train

# Without max_iter: so many epochs, or more if they make fewer steps than this.
_EPOCHS, _STEPS = 100, 5000
_BATCH_SIZE = 200  # "auto"
# Numbers held at once for each layer of a prediction.
_NUMBERS_AT_ONCE = 2**21


class BayesianMLPRegressor(MultiOutputMixin, RegressorMixin, StatefulEstimator):
    r"""Neural network with normal variational weights (a deep Bayesian neural network, the paper's DBNN).

    Layers of LeakyReLU units; each weight is normal, :math:`q(w) = N(\mu, s^2)`, independent of the others, its prior
    is :math:`N(0, \text{prior\_scale}^2)`, and biases are numbers. Each output has a learned noise variance. Adam
    minimises minus the evidence lower bound on mini-batches, through pre-activations drawn row by row (the local
    reparameterisation trick of Kingma et al. 2015). Inputs and targets are standardised inside.

    Parameters
    ----------
    hidden_layer_sizes : array-like of int or int, default=(50, 50)
        Units of each hidden layer. ``()`` is Bayesian linear regression by variational inference.
    negative_slope : float, default=0.01
        Of LeakyReLU, in [0, 1].
    prior_scale : float or array-like of shape (n_layers,), default=None
        Prior standard deviation of the weights of all layers or of each, for standardised inputs and targets. None is
        1 / sqrt(fan in): what a layer passes on is then of the size of what it receives, whatever its width.
    batch_size : int or "auto", default="auto"
        Rows per step; ``"auto"`` is 200. No more than there are rows.
    learning_rate_init : float, default=0.01
        Adam's first step size; it falls to zero along half a cosine: over ``max_iter`` epochs, or over the last steps.
    max_iter : int, default=None
        The most epochs (passes over the rows). None is 100, or more where that makes fewer than 5000 steps.
    tol : float, default=0.01
        In nats per row. Adam goes over to its last steps, as many as before, when the loss stays flat: when its median
        over the last third of the steps differs from that over the third before by less than this, or by no more than
        chance. With ``early_stopping``, also the least gain that counts.
    early_stopping : bool, default=False
        Whether to hold rows back and to keep the parameters that explain those best.
    validation_fraction : float, default=0.1
        Share of the rows held back, in (0, 1). Only with ``early_stopping``.
    n_iter_no_change : int, default=10
        Epochs in a row without a gain on the rows held back that end the fit. Only with ``early_stopping``.
    n_samples : int, default=100
        Draws of the weights behind predictions, made once at the end of `fit`. They take 8 bytes per weight each.
    warm_start : bool, default=False
        Whether to start from the last fit's parameters, where shapes agree.
    random_state : int, RandomState instance or None, default=None
        Draws first weights, mini-batches, pre-activations, rows held back and the weights behind predictions.
    verbose : int, default=0
        As of `EVGPRegressor`: iterations are steps, and the bound is that per row.

    Attributes
    ----------
    coefs_, coefs_std_ : list of ndarray of shape (fan_in, fan_out)
        Means and standard deviations of each layer's weights, in the units of ``X - X_mean_`` and y.
    intercepts_ : list of ndarray of shape (fan_out,)
        Biases of each layer.
    X_mean_ : ndarray of shape (n_features,)
        What is subtracted from the inputs.
    noise_variance_ : float or ndarray of shape (n_outputs,)
        σ², in squared units of y.
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the evidence lower bound per row, in nats: its mean over the mini-batches of each epoch.
    validation_scores_ : ndarray of shape (n_iter,) or None
        Expected log likelihood per row held back, in nats, after each epoch; None without ``early_stopping``.
    n_iter_ : int
        Epochs, the last one perhaps in part.
    n_parameters_ : int
        Two per weight, one per bias, and each output's noise.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    sklearn.neural_network.MLPRegressor : The network without uncertainty.

    Notes
    -----
    Weights are independent, a mean field: far from the data, predicted standard deviations are too small. Weights that
    the data do not need return to their prior; with few rows and much noise that may be all of them.

    References
    ----------
    - D. P. Kingma, T. Salimans, M. Welling (2015): Variational Dropout and the Local Reparameterization Trick.
    - D. P. Kingma, J. Ba (2015): Adam: A Method for Stochastic Optimization.

    Examples
    --------
    >>> from skevgp import BayesianMLPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = BayesianMLPRegressor((20,), max_iter=1000, tol=0.1, random_state=0).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> model.score(X, y) > 0.8
    True
    """

    _network: VariationalNetwork
    _scaling: Scaling
    _theta: np.ndarray

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "hidden_layer_sizes": ["array-like", Interval(Integral, 1, None, closed="left")],
        "negative_slope": [Interval(Real, 0, 1, closed="both")],
        "prior_scale": [Interval(Real, 0, None, closed="neither"), "array-like", None],
        "batch_size": [Interval(Integral, 1, None, closed="left"), StrOptions({"auto"})],
        "learning_rate_init": [Interval(Real, 0, None, closed="neither")],
        "max_iter": [Interval(Integral, 1, None, closed="left"), None],
        "tol": [Interval(Real, 0, None, closed="left")],
        "early_stopping": ["boolean"],
        "validation_fraction": [Interval(Real, 0, 1, closed="neither")],
        "n_iter_no_change": [Interval(Integral, 1, None, closed="left")],
        "n_samples": [Interval(Integral, 1, None, closed="left")],
        "warm_start": ["boolean"],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        hidden_layer_sizes: int | Sequence[int] = (50, 50),
        *,
        negative_slope: float = 0.01,
        prior_scale: float | Sequence[float] | None = None,
        batch_size: int | Literal["auto"] = "auto",
        learning_rate_init: float = 0.01,
        max_iter: int | None = None,
        tol: float = 0.01,
        early_stopping: bool = False,
        validation_fraction: float = 0.1,
        n_iter_no_change: int = 10,
        n_samples: int = 100,
        warm_start: bool = False,
        random_state: int | np.random.RandomState | None = None,
        verbose: int = 0,
    ):
        self.hidden_layer_sizes = hidden_layer_sizes
        self.negative_slope = negative_slope
        self.prior_scale = prior_scale
        self.batch_size = batch_size
        self.learning_rate_init = learning_rate_init
        self.max_iter = max_iter
        self.tol = tol
        self.early_stopping = early_stopping
        self.validation_fraction = validation_fraction
        self.n_iter_no_change = n_iter_no_change
        self.n_samples = n_samples
        self.warm_start = warm_start
        self.random_state = random_state
        self.verbose = verbose

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> Self:
        """Fit the distribution of the weights, the biases and the noise.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers up to 1e100; the largest of a column 0 or above 1e-140.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            The same of y.
        sample_weight : array-like of shape (n_samples,), default=None
            What each row's log likelihood is multiplied by: 0 removes the row, 2 is the row twice.

        Returns
        -------
        self : BayesianMLPRegressor
            Fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument, the data or their shapes are out of range; the message says what is allowed.

        Warns
        -----
        ConvergenceWarning
            If the loss still fell in the last epoch, or Ctrl-C ended the fit. It says what to change.
        """
        with unchanged_if_it_fails(self), single_threaded_libraries():
            message = self._fit(X, y, sample_weight)
        if message:
            warn_user(message, ConvergenceWarning)
        return self

    def predict(
        self, X: ArrayLike, return_std: bool = False, return_cov: bool = False, include_noise: bool = True
    ) -> Any:
        """Predict y by the mean over draws of the weights, the same draws for all rows and at each call.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.
        return_std, return_cov : bool, default=False
            Whether to return the standard deviation, or the covariance between rows, too.
        include_noise : bool, default=True
            Whether they are of y, with the learned noise, or of the noise-free function.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Of y at each row.
        std : ndarray of the same shape
            If ``return_std``.
        cov : ndarray of shape (n_samples, n_samples) or (n_samples, n_samples, n_outputs)
            If ``return_cov``.

        Raises
        ------
        ValueError
            If X does not fit the training data, is not finite, or both std and covariance are asked for.
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be asked for.")
        X = self._validated(X)
        scale, offset = self._scaling.y_scale, self._scaling.y_mean
        noise = self._noise if include_noise else np.zeros_like(self._noise)
        if return_cov:
            functions = self._values_of(X, self._weights)
            mean = functions.mean(axis=0)
            deviations = np.moveaxis(functions - mean, 2, 0)  # (n_outputs, n_samples, rows)
            cov = np.moveaxis(deviations.transpose(0, 2, 1) @ deviations, 0, 2) / len(functions)
            cov = (cov + np.eye(len(X))[:, :, np.newaxis] * noise) * scale**2
            return like_y(mean * scale + offset), like_y(cov)
        moments = [self._moments(X[rows]) for rows in self._blocks(len(X))]
        mean, variance = (np.concatenate(parts) for parts in zip(*moments, strict=True))
        mean = like_y(mean * scale + offset)
        return (mean, like_y(np.sqrt(variance + noise) * scale)) if return_std else mean

    def sample_y(
        self,
        X: ArrayLike,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = 0,
        include_noise: bool = True,
    ) -> np.ndarray:
        """Draw functions from the posterior at some rows, each with fresh weights.

        Parameters
        ----------
        X : array-like of shape (n_rows, n_features)
            Rows with the columns of `fit`.
        n_samples : int, default=1
            How many functions.
        random_state : int, RandomState instance or None, default=0
            Draws weights and noise.
        include_noise : bool, default=True
            Whether samples are of y, with the learned noise, or of the noise-free function.

        Returns
        -------
        samples : ndarray of shape (n_rows, n_samples) or (n_rows, n_outputs, n_samples)
            Each function at all rows.
        """
        X = self._validated(X)
        check_integer(n_samples, "n_samples", minimum=1)
        rng = np.random.default_rng(check_random_state(random_state).randint(2**31))
        samples = self._values_of(X, self._network.draw(self._theta, n_samples, rng))
        if include_noise:
            samples = samples + np.sqrt(self._noise) * rng.standard_normal(samples.shape)
        samples = np.moveaxis(samples * self._scaling.y_scale + self._scaling.y_mean, 0, 2)
        return samples[:, 0] if samples.shape[1] == 1 else samples

    def _fit(self, X: Any, y: Any, sample_weight: Any) -> str:
        """Fit, and say what the user should know of how it went."""
        inputs, targets, counts = self._intake(X, y, sample_weight)
        scaling = Scaling.of(inputs, targets, counts)
        network = self._network_of(inputs.shape[1], targets.shape[1])
        n_held_back = max(1, round(self.validation_fraction * len(inputs))) if self.early_stopping else 0
        n_kept = len(inputs) - n_held_back
        if n_kept == 0:
            raise ValueError(
                f"validation_fraction={self.validation_fraction!r} of {len(inputs)} rows leaves none to learn from."
            )
        batch_size = min(_BATCH_SIZE if isinstance(self.batch_size, str) else self.batch_size, n_kept)
        max_iter = self.max_iter or max(_EPOCHS, -(-_STEPS // -(-n_kept // batch_size)))
        rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
        start = network.start(rng)
        if self.warm_start and hasattr(self, "_theta") and self._network.sizes == network.sizes:
            scaling.take_over(self._scaling, self._network.split(self._theta), network.split(start))
        with monitor_of(self.verbose) as monitor:
            training = train(
                network,
                start,
                scaling.inputs(inputs),
                scaling.targets(targets),
                rng,
                n_held_back=n_held_back,
                max_iter=max_iter,
                batch_size=batch_size,
                learning_rate=self.learning_rate_init,
                tol=self.tol,
                patience=self.n_iter_no_change,
                monitor=monitor.seen_as(shift=scaling.log_unit),
                counts=counts,
            )
            self._network, self._scaling, self._theta = network, scaling, training.theta
            self._weights = network.draw(self._theta, self.n_samples, rng, mirrored=True)
            self.n_iter_, self.loss_curve_ = len(training.losses), training.losses + scaling.log_unit
            self.validation_scores_ = training.scores - scaling.log_unit if self.early_stopping else None
            self._set_attributes()
        return training.how_it_ended(max_iter, self.tol, monitor.stopped)

    def _intake(self, X: Any, y: Any, sample_weight: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Inputs (n, d) and targets (n, o) of the rows that count, and how often they do."""
        X, y = validate_numbers(self, X, y, reset=True, dtype=np.float64)
        targets = np.asarray(y, dtype=np.float64).reshape(len(X), -1)
        chosen = chosen_rows(X, targets, sample_weight)
        X, targets = rows_of(X, chosen.positions), rows_of(targets, chosen.positions)
        for values, name in ((X, "X"), (targets, "y")):
            check_size(values, name)
        return X, targets, chosen.counts

    def _network_of(self, n_features: int, n_outputs: int) -> VariationalNetwork:
        hidden = np.atleast_1d(np.asarray(self.hidden_layer_sizes))
        if hidden.ndim != 1 or (hidden.size and (hidden.dtype.kind not in "iu" or hidden.min() < 1)):
            raise ValueError(f"hidden_layer_sizes must be integers of at least 1; got {self.hidden_layer_sizes!r}.")
        sizes = [n_features, *hidden.tolist(), n_outputs]
        if self.prior_scale is None:
            return VariationalNetwork(sizes, [size**-0.5 for size in sizes[:-1]], self.negative_slope)
        scales = as_floats(self.prior_scale, "prior_scale")
        if scales.ndim > 1 or (scales.ndim == 1 and len(scales) != len(sizes) - 1):
            raise ValueError(
                f"prior_scale must be a number or {len(sizes) - 1}, one a layer; got {self.prior_scale!r}."
            )
        if not ((scales >= 1e-30) & (scales <= 1e30)).all():
            raise ValueError(f"prior_scale must be from 1e-30 to 1e30; got {self.prior_scale!r}.")
        return VariationalNetwork(sizes, np.broadcast_to(scales, len(sizes) - 1).tolist(), self.negative_slope)

    def _set_attributes(self) -> None:
        layers, log_noise = self._scaling.to_users(*self._network.split(self._theta))
        self.coefs_ = [layer.mean for layer in layers]
        self.coefs_std_ = [np.exp(layer.log_std) for layer in layers]
        self.intercepts_ = [layer.bias for layer in layers]
        self.X_mean_ = self._scaling.x_mean.copy()
        self.noise_variance_ = np.exp(log_noise) if len(log_noise) > 1 else float(np.exp(log_noise[0]))
        self.n_parameters_ = self._network.n_parameters

    @property
    def _noise(self) -> np.ndarray:
        return np.exp(self._network.split(self._theta)[1])

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_weights")

    def _validated(self, X: Any) -> np.ndarray:
        check_is_fitted(self)
        if not is_plain(self, X):
            X = validate_numbers(self, X, reset=False, dtype=np.float64)
            check_magnitude(X, "X")
        return X

    def _blocks(self, n_rows: int) -> list[slice]:
        size = max(1, _NUMBERS_AT_ONCE // (len(self._weights[0]) * max(w.shape[2] for w in self._weights)))
        return [slice(first, first + size) for first in range(0, n_rows, size)]

    def _values_of(self, X: np.ndarray, weights: list[np.ndarray]) -> np.ndarray:
        """Standardised outputs (n_draws, rows, n_outputs) without noise."""
        inputs = self._scaling.inputs(X)
        parts = [self._network.functions(self._theta, weights, inputs[rows]) for rows in self._blocks(len(X))]
        return np.concatenate(parts, axis=1)

    def _moments(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        functions = self._network.functions(self._theta, self._weights, self._scaling.inputs(X))
        return functions.mean(axis=0), functions.var(axis=0)

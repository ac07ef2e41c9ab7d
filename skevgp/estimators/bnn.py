"""BayesianMLPRegressor: a neural network whose weights are uncertain."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from ..data.threads import single_threaded_libraries
from ..data.weights import Chosen, rows_of
from ..exceptions import warn_user
from ..solvers.adam import adam, is_flat
from ..utils.monitor import Monitor, monitor_of
from ..utils.shapes import like_y
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.state import StatefulEstimator
from ..utils.validation import (
    LARGEST,
    as_floats,
    check_integer,
    check_magnitude,
    check_size,
    is_plain,
    unchanged_if_it_fails,
    validate_numbers,
)

# If max_iter is None: this many epochs, or more if they make fewer steps than this.
_EPOCHS, _STEPS = 100, 5000
# Steps that become small lower the loss by a few tol, also if more steps would gain little. It still falls at the end
# if it fell by more than so many tol over the last third of the steps, or by more than this share of its fall so far.
_LAST_FALL, _LAST_SHARE = 10.0, 0.2
# Rows per step if batch_size is "auto".
_BATCH_SIZE = 200
# Maximum number of floats in a layer of a prediction.
_NUMBERS_AT_ONCE = 2**21
# A column is constant if its entries differ by no more than this many rounding errors.
_ROUNDING = 8.0 * np.finfo(float).eps
# Added to the variance of a pre-activation, whose square root needs a slope even if all inputs are 0.
_TINY = 1e-32
# Bounds of the standard deviations, in units of the prior's, and of the noise variances of standardised targets.
_STD, _NOISE_VARIANCE = (1e-9, 1e3), (1e-12, 1e6)
# Standard deviations start at this share of the prior's. Those of weights that the data do not determine grow later.
_FIRST_STD = 0.01
# Messages of warnings.
_INTERRUPTED = "The fit was interrupted in epoch {}; the best parameters so far are kept."
_NOT_FINITE = "The loss did not stay finite; the best parameters so far are kept. Lower learning_rate_init."
_STILL_FELL = (
    "The loss still fell when max_iter={max_iter} epochs were used up. Raise max_iter, or stop earlier on purpose with "
    "a larger tol (now {tol})."
)


class BayesianMLPRegressor(MultiOutputMixin, RegressorMixin, StatefulEstimator):
    r"""Deep Bayesian neural network, the DBNN of the paper.

    The hidden layers are LeakyReLU units. Each weight has an independent normal distribution :math:`q(w) = N(\mu,
    s^2)`, and the prior :math:`N(0, \text{prior\_scale}^2)`. Adam maximises the evidence lower bound on mini-batches
    with the local reparameterisation trick. The noise variance of each output is learned. Inputs and targets are
    standardised internally.

    Parameters
    ----------
    hidden_layer_sizes : array-like of int or int, default=(50, 50)
        Number of units of each hidden layer. ``()`` is Bayesian linear regression by variational inference.
    negative_slope : float, default=0.01
        Slope of LeakyReLU for negative inputs, in [0, 1].
    prior_scale : float or array-like of shape (n_layers,), default=None
        Prior standard deviation of the weights of all layers, or of each layer, for standardised inputs and targets. If
        None, 1 / sqrt(fan in).
    batch_size : int or "auto", default="auto"
        Number of rows per step. If ``"auto"``, 200, or all rows if there are fewer.
    learning_rate_init : float, default=0.01
        First step size of Adam. It falls to zero along half a cosine.
    max_iter : int, default=None
        Maximum number of epochs, which are passes over the rows. If None, 100 epochs or 5000 steps, whichever is more.
    tol : float, default=0.01
        Tolerance of the loss, in nats per row. When the median loss over a third of the steps changes by less, Adam
        begins its last steps. With ``early_stopping``, ``tol`` is also the least gain that counts.
    early_stopping : bool, default=False
        Whether to hold out rows, and keep the parameters that predict these rows best.
    validation_fraction : float, default=0.1
        Share of the rows that ``early_stopping`` holds out, in (0, 1).
    n_iter_no_change : int, default=10
        Number of epochs without a gain on the held-out rows after which ``early_stopping`` ends the fit.
    n_samples : int, default=100
        Number of draws of the weights for predictions, at least 2. They are drawn once, at the end of `fit`.
    warm_start : bool, default=False
        Whether to start from the parameters of the last fit, if it had the same layers.
    random_state : int, RandomState instance or None, default=None
        Seed of the first weights, mini-batches, pre-activations, held-out rows and the weights for predictions.
    verbose : int, default=0
        Verbosity, as in `EVGPRegressor`. An iteration is a step, and the bound is per row.

    Attributes
    ----------
    coefs_, coefs_std_ : list of ndarray of shape (fan_in, fan_out)
        Means and standard deviations of the weights of each layer, in the units of ``X - X_mean_`` and y.
    intercepts_ : list of ndarray of shape (fan_out,)
        Biases of each layer.
    X_mean_ : ndarray of shape (n_features,)
        Means of the inputs, which are subtracted.
    noise_variance_ : float or ndarray of shape (n_outputs,)
        Noise variance of each output, in squared units of y.
    loss_curve_ : ndarray of shape (n_iter,)
        Minus the evidence lower bound per row, in nats, averaged over the mini-batches of each epoch.
    validation_scores_ : ndarray of shape (n_iter,) or None
        Expected log likelihood per held-out row, in nats, after each epoch. It is None without ``early_stopping``.
    n_iter_ : int
        Number of epochs. The last one may be incomplete.
    n_parameters_ : int
        Number of parameters of weights, biases and noise.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it had any.

    See Also
    --------
    sklearn.neural_network.MLPRegressor : The network without uncertainty.

    Notes
    -----
    The weights are independent (mean field). Therefore, predicted standard deviations are too small far from the data.
    With few rows and much noise, all weights may return to their prior.

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
    _weights: list[np.ndarray]

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
        "n_samples": [Interval(Integral, 2, None, closed="left")],  # one draw has no spread
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
            Inputs, up to 1e100 in size. The largest of a column must be 0 or above 1e-140.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets, with the same limits.
        sample_weight : array-like of shape (n_samples,), default=None
            Factor of the log likelihood of each row. 0 removes the row, and 2 counts it twice.

        Returns
        -------
        self : BayesianMLPRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError, TypeError
            If an argument, the data or their shapes are out of range.

        Warns
        -----
        ConvergenceWarning
            If the loss still fell much when ``max_iter`` epochs were used up: over the last third of the steps, by ten
            times ``tol`` or by a fifth of its fall so far. If the loss did not stay finite, or Ctrl-C ended the fit.
        """
        with unchanged_if_it_fails(self), single_threaded_libraries():
            inputs, targets = validate_numbers(self, X, y, reset=True, dtype=np.float64)
            targets = np.asarray(targets, dtype=np.float64).reshape(len(inputs), -1)
            # Rows of weight 0 are left out. counts (n,) are the weights of the others, or None if all are 1.
            chosen = Chosen.of(inputs, targets, sample_weight)
            inputs, targets = rows_of(inputs, chosen.positions), rows_of(targets, chosen.positions)
            check_size(inputs, "X")
            check_size(targets, "y")
            scaling = Scaling.of(inputs, targets, chosen.counts)
            inputs, targets = scaling.inputs(inputs), scaling.targets(targets)
            sizes = self._layer_sizes(inputs.shape[1], targets.shape[1])
            network = VariationalNetwork(sizes, self._prior_scales(sizes), self.negative_slope)
            rng = np.random.default_rng(check_random_state(self.random_state).randint(2**31))
            theta = network.start(rng)
            if self.warm_start and hasattr(self, "_theta") and self._network.sizes == network.sizes:
                theta = scaling.from_users(network, self._scaling.to_users(network, self._theta), self._scaling.x_mean)
            with monitor_of(self.verbose) as monitor:
                # A row's log density of y is that of the standardised y minus Σ_o log(scale_o).
                log_unit = float(np.log(scaling.y_scale).sum())
                monitor = monitor.seen_as(shift=log_unit)
                trained = self._train(network, theta, inputs, targets, chosen.counts, rng, monitor)
                theta, losses, scores, message = trained
                self._network, self._scaling, self._theta = network, scaling, theta
                self._weights = network.draw(theta, self.n_samples, rng, mirrored=True)
                layers, log_noise = network.split(scaling.to_users(network, theta))
                self.coefs_ = [layer.mean for layer in layers]
                self.coefs_std_ = [np.exp(layer.log_std) for layer in layers]
                self.intercepts_ = [layer.bias for layer in layers]
                self.X_mean_ = scaling.x_mean.copy()
                self.noise_variance_ = np.exp(log_noise) if len(log_noise) > 1 else float(np.exp(log_noise[0]))
                self.loss_curve_, self.n_iter_ = losses + log_unit, len(losses)
                self.validation_scores_ = scores - log_unit if self.early_stopping else None
                self.n_parameters_ = network.n_parameters
            if monitor.interrupted:
                message = _INTERRUPTED.format(self.n_iter_)
        if message:
            warn_user(message, ConvergenceWarning)
        return self

    def predict(
        self, X: ArrayLike, return_std: bool = False, return_cov: bool = False, include_noise: bool = True
    ) -> Any:
        """Predict the mean over draws of the weights.

        All rows and all calls use the same draws.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.
        return_std, return_cov : bool, default=False
            Whether to return the standard deviation, or the covariance between rows, too.
        include_noise : bool, default=True
            Whether the standard deviation and the covariance include the learned noise.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Predicted mean of y at each row.
        std : ndarray of the same shape
            Standard deviation. It is returned only if ``return_std`` is True.
        cov : ndarray of shape (n_samples, n_samples) or (n_samples, n_samples, n_outputs)
            Covariance between rows. It is returned only if ``return_cov`` is True.

        Raises
        ------
        ValueError
            If X does not fit the training data or is not finite, or if both ``return_std`` and ``return_cov`` are set.
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be requested.")
        blocks = self._blocks_of_outputs(self._validated(X), self._weights)
        scale, offset = self._scaling.y_scale, self._scaling.y_mean
        noise = self._noise if include_noise else np.zeros_like(self._noise)
        if return_cov:
            functions = np.concatenate(list(blocks), axis=1)
            mean = functions.mean(axis=0)
            deviations = np.moveaxis(functions - mean, 2, 0)  # (o, n_draws, n)
            cov = np.moveaxis(deviations.transpose(0, 2, 1) @ deviations, 0, 2) / len(functions)  # (n, n, o)
            cov = (cov + np.eye(len(mean))[:, :, np.newaxis] * noise) * scale**2
            return like_y(mean * scale + offset), like_y(cov)
        moments = [(functions.mean(axis=0), functions.var(axis=0)) for functions in blocks]
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
            Number of functions.
        random_state : int, RandomState instance or None, default=0
            Seed of weights and noise.
        include_noise : bool, default=True
            Whether to add the learned noise.

        Returns
        -------
        samples : ndarray of shape (n_rows, n_samples) or (n_rows, n_outputs, n_samples)
            Each function at all rows.
        """
        X = self._validated(X)
        check_integer(n_samples, "n_samples", minimum=1)
        rng = np.random.default_rng(check_random_state(random_state).randint(2**31))
        weights = self._network.draw(self._theta, n_samples, rng)
        samples = np.concatenate(list(self._blocks_of_outputs(X, weights)), axis=1)
        if include_noise:
            samples = samples + np.sqrt(self._noise) * rng.standard_normal(samples.shape)
        samples = np.moveaxis(samples * self._scaling.y_scale + self._scaling.y_mean, 0, 2)
        return samples[:, 0] if samples.shape[1] == 1 else samples

    def _layer_sizes(self, n_features: int, n_outputs: int) -> tuple[int, ...]:
        hidden = np.atleast_1d(np.asarray(self.hidden_layer_sizes))
        if hidden.ndim != 1 or (hidden.size and (hidden.dtype.kind not in "iu" or hidden.min() < 1)):
            raise ValueError(f"hidden_layer_sizes must be integers of at least 1; got {self.hidden_layer_sizes!r}.")
        return (n_features, *hidden.tolist(), n_outputs)

    def _prior_scales(self, sizes: Sequence[int]) -> np.ndarray:
        if self.prior_scale is None:
            return np.array([size**-0.5 for size in sizes[:-1]])
        scales = as_floats(self.prior_scale, "prior_scale")
        if scales.ndim > 1 or (scales.ndim == 1 and len(scales) != len(sizes) - 1):
            raise ValueError(
                f"prior_scale must be a number or one for each of {len(sizes) - 1} layers; got {self.prior_scale!r}."
            )
        if not ((scales >= 1e-30) & (scales <= 1e30)).all():
            raise ValueError(f"prior_scale must be from 1e-30 to 1e30; got {self.prior_scale!r}.")
        return np.broadcast_to(scales, len(sizes) - 1)

    def _train(
        self,
        network: VariationalNetwork,
        start: np.ndarray,
        X: np.ndarray,
        Y: np.ndarray,
        counts: np.ndarray | None,
        rng: np.random.Generator,
        monitor: Monitor,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
        """Run Adam on mini-batches; return parameters, loss and score of each epoch, and a message or ""."""
        n_held_back = max(1, round(self.validation_fraction * len(X))) if self.early_stopping else 0
        if n_held_back == len(X):
            raise ValueError(
                f"validation_fraction={self.validation_fraction!r} of {len(X)} rows leaves no rows for training."
            )
        held_back = np.zeros(len(X), dtype=np.bool_)
        held_back[rng.permutation(len(X))[:n_held_back]] = True
        n_rows = float((~held_back).sum() if counts is None else counts[~held_back].sum())
        (X_held, Y_held, weights_held), (X, Y, weights) = (
            (X[rows], Y[rows], None if counts is None or not rows.any() else counts[rows] / counts[rows].mean())
            for rows in (held_back, ~held_back)
        )
        batch_size = min(_BATCH_SIZE if isinstance(self.batch_size, str) else self.batch_size, len(X))
        steps = -(-len(X) // batch_size)
        max_iter = self.max_iter or max(_EPOCHS, -(-_STEPS // steps))
        order = np.empty(0, dtype=int)

        def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
            """Return minus the bound per row on the next mini-batch; rows are shuffled at the start of each epoch."""
            nonlocal order
            if len(order) == 0:
                order = rng.permutation(len(X))
            batch, order = order[:batch_size], order[batch_size:]
            draws = rng.standard_normal((len(batch), network.n_hidden))
            own = None if weights is None else weights[batch]
            return network.loss_and_gradient(theta, X[batch], Y[batch], draws, n_rows, own)

        watch = None
        if n_held_back > 0:
            # The same draws in each epoch: scores differ only because parameters differ.
            draws = rng.standard_normal((n_held_back, network.n_hidden))
            watch = _EarlyStopping(
                lambda theta: network.expected_log_likelihood(theta, X_held, Y_held, draws, weights_held),
                steps,
                self.tol,
                self.n_iter_no_change,
            )
        limits, rate = network.limits(), self.learning_rate_init
        minimum = adam(objective, start, limits, max_iter * steps, rate, self.tol, monitor, stop=watch)
        theta = minimum.x if watch is None or watch.theta is None else watch.theta
        losses, scores = np.array(minimum.loss_curve), np.array([] if watch is None else watch.scores)
        epochs = np.array([losses[first : first + steps].mean() for first in range(0, len(losses), steps)])
        still_falls = minimum.n_iter == max_iter * steps and _still_falls(losses, self.tol)
        message = _STILL_FELL.format(max_iter=max_iter, tol=self.tol) if still_falls else ""
        return theta, epochs, scores, message if minimum.converged else _NOT_FINITE

    @property
    def _noise(self) -> np.ndarray:
        """Noise variances (o,) of standardised targets."""
        return np.exp(self._network.split(self._theta)[1])

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_weights")

    def _validated(self, X: Any) -> np.ndarray:
        check_is_fitted(self)
        if not is_plain(self, X):
            X = validate_numbers(self, X, reset=False, dtype=np.float64)
            check_magnitude(X, "X")
        return X

    def _blocks_of_outputs(self, X: np.ndarray, weights: list[np.ndarray]) -> Iterator[np.ndarray]:
        """Yield standardised outputs (n_draws, rows, o) without noise, one block of rows at a time."""
        size = max(1, _NUMBERS_AT_ONCE // (len(weights[0]) * max(drawn.shape[2] for drawn in weights)))
        for first in range(0, len(X), size):
            yield self._network.functions(self._theta, weights, self._scaling.inputs(X[first : first + size]))


def _still_falls(losses: np.ndarray, tol: float) -> bool:
    """Whether the loss fell much over the last third of the steps, or by a large share of its fall so far."""
    n = len(losses) // 3
    if n == 0 or is_flat(losses, tol):
        return n == 0
    first, middle, last = (float(np.median(part)) for part in (losses[:n], losses[-2 * n : -n], losses[-n:]))
    return middle - last > min(_LAST_FALL * tol, _LAST_SHARE * (first - last))


class _EarlyStopping:
    """Score the parameters after each epoch, keep the best, and stop after ``patience`` epochs without a gain."""

    def __init__(self, score: Callable[[np.ndarray], float], steps_per_epoch: int, tol: float, patience: int):
        self._score, self._steps, self._tol, self._patience = score, steps_per_epoch, tol, patience
        self._n_steps, self._since_gain, self._best, self._bar = 0, 0, -np.inf, -np.inf
        self.theta: np.ndarray | None = None
        self.scores: list[float] = []

    def __call__(self, theta: np.ndarray) -> bool:
        self._n_steps += 1
        if self._n_steps % self._steps:
            return False
        score = self._score(theta)
        self.scores.append(score)
        if score > self._best:
            self._best, self.theta = score, theta
        self._since_gain += 1
        if score > self._bar + self._tol:
            self._bar, self._since_gain = score, 0
        return self._since_gain >= self._patience


class Layer(NamedTuple):
    """Weights (fan in, fan out) with means and log standard deviations, and biases (fan out,)."""

    mean: np.ndarray
    log_std: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True)
class Scaling:
    """Means and scales of the columns of X and y, between the user's units and standardised ones."""

    x_mean: np.ndarray  # (d,)
    x_scale: np.ndarray
    y_mean: np.ndarray  # (o,)
    y_scale: np.ndarray

    @classmethod
    def of(cls, X: np.ndarray, Y: np.ndarray, counts: np.ndarray | None = None) -> Scaling:
        """Return the scaling of a training set, whose rows count ``counts`` times, or once."""
        return cls(*_mean_and_scale(X, counts), *_mean_and_scale(Y, counts))

    def inputs(self, X: np.ndarray) -> np.ndarray:
        """Standardise inputs, and clip those whose squares would overflow."""
        return np.clip((X - self.x_mean) / self.x_scale, -LARGEST, LARGEST)

    def targets(self, Y: np.ndarray) -> np.ndarray:
        """Standardise targets."""
        return (Y - self.y_mean) / self.y_scale

    # With D = diag(x_scale), S = diag(y_scale) and standardised inputs (x - x_mean) D⁻¹, the first layer's weights are
    # D⁻¹ W as weights of x - x_mean. The last layer's weights are W S, and its biases b S + y_mean, as those of y.

    def to_users(self, network: VariationalNetwork, theta: np.ndarray) -> np.ndarray:
        """Return the parameters of the same network as a function of ``X - x_mean``, in units of X and y."""
        theta = theta.copy()
        layers, log_noise = network.split(theta)
        first, last, columns = layers[0], layers[-1], self.x_scale[:, np.newaxis]
        first.mean[:] /= columns
        first.log_std[:] -= np.log(columns)
        last.mean[:] *= self.y_scale
        last.log_std[:] += np.log(self.y_scale)
        last.bias[:] = last.bias * self.y_scale + self.y_mean
        log_noise += 2.0 * np.log(self.y_scale)
        return theta

    def from_users(self, network: VariationalNetwork, theta: np.ndarray, x_mean: np.ndarray) -> np.ndarray:
        """Invert `to_users`, for a network that is a function of ``X - x_mean`` with another ``x_mean``."""
        theta = theta.copy()
        layers, log_noise = network.split(theta)
        first, last, columns = layers[0], layers[-1], self.x_scale[:, np.newaxis]
        # (x - x_mean) W = (x - self.x_mean) W + (self.x_mean - x_mean) W
        first.bias[:] += (self.x_mean - x_mean) @ first.mean
        first.mean[:] *= columns
        first.log_std[:] += np.log(columns)
        last.mean[:] /= self.y_scale
        last.log_std[:] -= np.log(self.y_scale)
        last.bias[:] = (last.bias - self.y_mean) / self.y_scale
        log_noise -= 2.0 * np.log(self.y_scale)
        return theta


def _mean_and_scale(values: np.ndarray, counts: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of each column; the scale of a constant column is its size, or 1."""
    largest = np.abs(values).max(axis=0)
    constant = np.ptp(values, axis=0) <= _ROUNDING * largest
    mean = values.mean(axis=0) if counts is None else counts @ values / counts.sum()
    mean = np.where(constant, values[0], mean)
    deviations = values - mean
    std = deviations.std(axis=0) if counts is None else np.sqrt(counts @ deviations**2 / counts.sum())
    scale = np.where(constant, largest, std)
    return mean, np.where(scale > 0.0, scale, 1.0)


class VariationalNetwork:
    """LeakyReLU layers with independent weights w ~ N(mean, std²) and biases that are numbers."""

    def __init__(self, sizes: Sequence[int], prior_scales: Sequence[float] | np.ndarray, negative_slope: float):
        # The parameters θ are one flat vector: the means of all layers, their log standard deviations, their biases,
        # and a log noise variance for each output. sizes are the units of each layer, inputs first and outputs last.
        # The prior of the weights of a layer is N(0, prior_scale²).
        self.sizes, self.slope, self.prior_log_stds = tuple(sizes), negative_slope, np.log(prior_scales)
        matrices, vectors = list(pairwise(self.sizes)), [(size,) for size in self.sizes[1:]]
        self.n_hidden = sum(self.sizes[1:-1])
        self.n_parameters = 0
        self._parts: list[tuple[slice, tuple[int, ...]]] = []
        for shape in [*matrices, *matrices, *vectors, vectors[-1]]:
            first, self.n_parameters = self.n_parameters, self.n_parameters + int(np.prod(shape))
            self._parts.append((slice(first, self.n_parameters), shape))

    def split(self, vector: np.ndarray) -> tuple[list[Layer], np.ndarray]:
        """Return views of a flat vector: the layers, and the log noise variances (o,)."""
        parts = [vector[part].reshape(shape) for part, shape in self._parts]
        n_layers = len(self.sizes) - 1
        # Means, then log standard deviations, then biases: each third has one part per layer.
        return [Layer(*parts[k : 3 * n_layers : n_layers]) for k in range(n_layers)], parts[-1]

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return wide lower and upper bounds of θ."""
        lower, upper = np.full(self.n_parameters, -np.inf), np.full(self.n_parameters, np.inf)
        for bound, std, noise in zip((lower, upper), _STD, _NOISE_VARIANCE, strict=True):
            layers, log_noise = self.split(bound)
            for layer, prior_log_std in zip(layers, self.prior_log_stds, strict=True):
                layer.log_std[:] = prior_log_std + np.log(std)
            log_noise[:] = np.log(noise)
        return lower, upper

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """Return the first θ: means as in He et al. (2015), small for the outputs, small deviations, biases 0."""
        theta = np.zeros(self.n_parameters)
        layers, _ = self.split(theta)
        gain = np.sqrt(2.0 / (1.0 + self.slope**2))
        for k, layer in enumerate(layers):
            draws, fan_in = rng.standard_normal(layer.mean.shape), len(layer.mean)
            is_hidden = k < len(layers) - 1
            layer.mean[:] = gain / np.sqrt(fan_in) * draws if is_hidden else draws * 0.1 / np.sqrt(fan_in)
            layer.log_std[:] = self.prior_log_stds[k] + np.log(_FIRST_STD)
        return theta

    def loss_and_gradient(
        self,
        theta: np.ndarray,
        X: np.ndarray,
        Y: np.ndarray,
        draws: np.ndarray,
        n_rows: float,
        weights: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:
        """Return minus the evidence lower bound per row in nats, estimated by b of n_rows rows, and its gradient."""
        # draws (b, n_hidden) are standard normal. weights (b,) are how often rows count; None means once.
        # loss = ½ Σ_o [log 2π + log σ_o² + e_o / σ_o²] + KL[q(w) | p(w)] / n_rows,
        # e_o = mean over rows of (y - m)² + v: the expected squared error, with moments m and v of the outputs.
        layers, log_noise = self.split(theta)
        gradient = np.empty_like(theta)
        slopes, noise_slope = self.split(gradient)
        inputs, variances, spreads, mean, variance = self._forward(layers, X, draws)
        error, precision = Y - mean, np.exp(-log_noise)
        misfit = _mean(error**2 + variance, weights)
        loss = _log_loss(misfit, log_noise)
        noise_slope[:] = 0.5 - 0.5 * precision * misfit
        # ∂loss/∂m and ∂loss/∂v, (b, o) at first, then of the pre-activations of the layer before.
        to_mean = error * (-precision / len(X))
        to_variance = np.broadcast_to(0.5 * precision / len(X), error.shape)
        if weights is not None:
            to_mean *= weights[:, np.newaxis]
            to_variance = to_variance * weights[:, np.newaxis]
        ends = np.cumsum(self.sizes[1:-1])
        for k in reversed(range(len(layers))):
            layer, slope = layers[k], slopes[k]
            # m = X M + b and v = X² V, with the layer's inputs X (b, i), means M and variances V = exp(2 log s) (i, j).
            np.matmul(inputs[k].T, to_mean, out=slope.mean)
            np.matmul((inputs[k] ** 2).T, to_variance, out=slope.log_std)
            to_mean.sum(axis=0, out=slope.bias)
            if k > 0:
                # X = LeakyReLU(z), z = m + √v ε of the layer before: ∂z/∂m = 1, ∂z/∂v = ε / (2 √v).
                to_z = to_mean @ layer.mean.T + 2.0 * inputs[k] * (to_variance @ variances[k].T)
                to_z *= np.where(inputs[k] > 0.0, 1.0, self.slope)
                noise = draws[:, ends[k - 1] - self.sizes[k] : ends[k - 1]]
                to_mean, to_variance = to_z, 0.5 * to_z * noise / spreads[k - 1]
            # KL = Σ [log(p / s) + (s² + M²) / (2 p²) - ½], with the prior's standard deviation p; ∂V/∂(log s) = 2 V.
            prior_log_std, prior_precision = self.prior_log_stds[k], np.exp(-2.0 * self.prior_log_stds[k])
            divergence = 0.5 * (layer.mean**2 + variances[k]) * prior_precision + prior_log_std - layer.log_std - 0.5
            loss += float(divergence.sum()) / n_rows
            slope.mean[:] += layer.mean * prior_precision / n_rows
            slope.log_std[:] *= 2.0 * variances[k]
            slope.log_std[:] += (variances[k] * prior_precision - 1.0) / n_rows
        return loss, gradient

    def expected_log_likelihood(
        self, theta: np.ndarray, X: np.ndarray, Y: np.ndarray, draws: np.ndarray, weights: np.ndarray | None = None
    ) -> float:
        """Return the expected log likelihood per row in nats, with the arguments of `loss_and_gradient`."""
        layers, log_noise = self.split(theta)
        *_, mean, variance = self._forward(layers, X, draws)
        return -_log_loss(_mean((Y - mean) ** 2 + variance, weights), log_noise)

    def draw(
        self, theta: np.ndarray, n_draws: int, rng: np.random.Generator, mirrored: bool = False
    ) -> list[np.ndarray]:
        """Draw weights (n_draws, fan in, fan out) of each layer, if mirrored in pairs M ± s ε."""
        weights = []
        for layer in self.split(theta)[0]:
            deviations = rng.standard_normal(((n_draws + 1) // 2 if mirrored else n_draws, *layer.mean.shape))
            if mirrored:  # odd terms of the deviations cancel, so that a few draws have a good mean
                deviations = np.concatenate([deviations, -deviations])[:n_draws]
            weights.append(layer.mean + np.exp(layer.log_std) * deviations)
        return weights

    def functions(self, theta: np.ndarray, weights: list[np.ndarray], X: np.ndarray) -> np.ndarray:
        """Return outputs (n_draws, b, o) without noise at rows X (b, d), for each draw of the weights."""
        layers, _ = self.split(theta)
        outputs = X[np.newaxis]
        for k, (layer, drawn) in enumerate(zip(layers, weights, strict=True)):
            outputs = outputs @ drawn + layer.bias
            if k < len(layers) - 1:
                outputs = np.maximum(outputs, self.slope * outputs)
        return outputs

    def _forward(self, layers: list[Layer], X: np.ndarray, draws: np.ndarray) -> tuple[Any, ...]:
        """Return inputs and weight variances of the layers, √v of hidden layers, and moments m and v of the outputs."""
        # A pre-activation is a sum of normal weights times inputs, so it is normal: z ~ N(X M + b, X² V). It is drawn
        # row by row instead of the weights (Kingma, Salimans & Welling 2015, section 2.2). Those of the outputs are not
        # drawn, because the normal likelihood is integrated over them in closed form.
        inputs, variances, spreads, first = [X], [np.exp(2.0 * layer.log_std) for layer in layers], [], 0
        for layer, variance in zip(layers[:-1], variances, strict=False):
            noise = draws[:, first : first + len(layer.bias)]
            first += len(layer.bias)
            spreads.append(np.sqrt(inputs[-1] ** 2 @ variance + _TINY))
            z = inputs[-1] @ layer.mean + layer.bias + spreads[-1] * noise
            inputs.append(np.maximum(z, self.slope * z))
        mean = inputs[-1] @ layers[-1].mean + layers[-1].bias
        return inputs, variances, spreads, mean, inputs[-1] ** 2 @ variances[-1]


def _mean(values: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Return the mean over rows, with weights of mean 1."""
    return values.mean(axis=0) if weights is None else weights @ values / len(values)


def _log_loss(misfit: np.ndarray, log_noise: np.ndarray) -> float:
    """Return minus the expected log density of a row: ½ Σ_o [log 2π + log σ_o² + e_o / σ_o²]."""
    return 0.5 * float((np.log(2.0 * np.pi) + log_noise + misfit * np.exp(-log_noise)).sum())

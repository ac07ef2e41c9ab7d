"""Multi-step prediction with a learned one-step model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import Bunch, check_random_state

from ..exceptions import UnstableRolloutWarning, ignored, warn_user
from ..utils.frames import as_fitted, package_of
from ..utils.validation import LARGEST, as_floats, check_fitted, check_integer

# (states (n, n_states), step) -> inputs (n, n_inputs).
Controller = Callable[[np.ndarray, int], ArrayLike]

_METHODS = ("sample", "linearized", "mean")
_NOISES = ("learned", "none")
_REMEDY = (
    "The model is unstable there, or they left the training data. Use more inducing points, more data, or fewer steps."
)
# Width of finite differences, as a share of the standard deviations.
_SHARE = 0.01
# Particles run away if a standard deviation is larger than the interquartile range by the first factor, and than the
# path of the median by the second. That of a normal distribution is 0.74 times its interquartile range.
_RUNAWAY, _BEYOND = 100.0, 10.0


def rollout(
    regressor: Any,
    z0: ArrayLike,
    U_or_controller: ArrayLike | Controller,
    *,
    n_steps: int | None = None,
    n_samples: int = 100,
    method: Literal["sample", "linearized", "mean"] = "sample",
    process_noise: Literal["learned", "none"] = "learned",
    random_state: int | np.random.RandomState | None = None,
) -> Bunch:
    """Predict many steps ahead, with uncertainty.

    Parameters
    ----------
    regressor : estimator
        Model of one step, fitted to rows [z, u] and next states z'.
    z0 : array-like of shape (n_states,) or (n_batch, n_states)
        Initial states.
    U_or_controller : array-like of shape (n_steps, n_inputs) or (n_batch, n_steps, n_inputs), or callable
        Inputs, or a function ``controller(z, t)`` of states (n, n_states) and the step t, which returns inputs (n,
        n_inputs).
    n_steps : int, default=None
        Number of steps, only with a controller.
    n_samples : int, default=100
        Number of particles for each initial state, at least 2 with ``method="sample"``. The other methods do not use
        it.
    method : {"sample", "linearized", "mean"}, default="sample"
        - ``"sample"``: each particle follows one function drawn from the posterior.
        - ``"linearized"``: mean and covariance to first order, with independent steps.
        - ``"mean"``: each step starts from the mean of the step before.
    process_noise : {"learned", "none"}, default="learned"
        Whether to add the learned noise at each step. If states are noisy, intervals are often too narrow with
        ``"none"``, and may be too wide with ``"learned"``.
    random_state : int, RandomState instance or None, default=None
        Seed of the particles.

    Returns
    -------
    rollout : Bunch
        Values after each step, with a first axis of length n_batch if z0 has one:

        - mean, std : ndarray of shape (n_steps, n_states)
        - covariance : ndarray of shape (n_steps, n_states, n_states). That of samples has the divisor n_samples - 1
        - samples : ndarray of shape (n_samples, n_steps, n_states), with ``method="sample"``
        - inputs : ndarray of shape (n_steps, n_inputs), or (n_samples, n_steps, n_inputs) with samples and a controller

    Raises
    ------
    ValueError, TypeError
        If shapes do not fit, a value is not finite, or the regressor has no ``return_std``. If ``n_samples`` is too
        small.
    NotFittedError
        If the regressor is not fitted.

    Warns
    -----
    UnstableRolloutWarning
        If at most a quarter of the particles run away, and dominate mean and standard deviation.

    Notes
    -----
    See the user guide, :doc:`/guide/rollouts`.

    Examples
    --------
    >>> from skevgp import EVGPRegressor, rollout
    >>> from skevgp.datasets import make_dynamics
    >>> from skevgp.features import InertiaForceGravity
    >>> train, test = (make_dynamics("pendulum", n, random_state=s) for n, s in [(4, 0), (1, 1)])
    >>> model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=5, random_state=0)
    >>> model = model.fit(train.data, train.target, groups=train.groups)
    >>> ahead = rollout(model, test.data[0, :2], test.data[:50, 2:], random_state=0)
    >>> ahead.samples.shape, ahead.mean.shape
    ((100, 50, 2), (50, 2))
    """
    check_fitted(regressor)
    if method not in _METHODS:
        raise ValueError(f"method must be one of {_METHODS}; got {method!r}.")
    if process_noise not in _NOISES:
        raise ValueError(f"process_noise must be one of {_NOISES}; got {process_noise!r}.")
    if method == "sample":
        check_integer(n_samples, 'n_samples of method="sample"', minimum=2)  # one particle has no spread
    else:
        check_integer(n_samples, "n_samples", minimum=1)
    states = _finite(z0, "z0")
    if states.ndim not in (1, 2) or 0 in states.shape:
        raise ValueError(f"z0 must be of shape (n_states,) or (n_batch, n_states); got {states.shape}.")
    batch = np.atleast_2d(states)
    drive = _drive(regressor, batch, U_or_controller, n_steps)
    model = _OneStep(regressor, batch.shape[1], process_noise == "learned")
    if method == "sample":
        found = _sampled(model, batch, drive, n_samples, check_random_state(random_state))
    else:
        found = _fed_back(model, batch, drive, method == "linearized")
    return Bunch(**{name: values if states.ndim == 2 else values[0] for name, values in found.items()})


@dataclass(frozen=True)
class _Drive:
    """The inputs of the system: an array (n_batch, n_steps, n_inputs), or a controller."""

    n_steps: int
    n_inputs: int
    inputs: np.ndarray | None
    controller: Controller | None

    def at(self, t: int, states: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the inputs (n, n_inputs) of states (n, n_states); ``of`` (n,) gives the initial state of each."""
        if self.inputs is not None:
            return self.inputs[of, t]
        assert self.controller is not None
        given = _finite(self.controller(states.copy(), t), "What the controller returns")
        if given.shape not in ((len(states), self.n_inputs), (self.n_inputs,)):
            raise ValueError(
                f"The controller must return inputs of shape (n, n_inputs) = {(len(states), self.n_inputs)}; got "
                f"{given.shape}."
            )
        return np.broadcast_to(given, (len(states), self.n_inputs))

    def slopes(self, t: int, states: np.ndarray, deviations: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return ∂u/∂z (n, n_inputs, n_states) by central differences, for states with deviations (n, n_states)."""
        if self.inputs is not None:
            return np.zeros((len(states), self.n_inputs, states.shape[1]))
        return _differences(lambda own: self.at(t, own, of), states, deviations)


class _OneStep:
    """A regressor as a model of one step, with as much of its posterior as it offers."""

    def __init__(self, regressor: Any, n_states: int, noisy: bool):
        self.regressor, self.n_states, self.noisy = regressor, n_states, noisy
        # The posterior as functions that can be drawn, or None for regressors of other packages.
        posterior = getattr(regressor, "_posterior", None)
        self.functions = None if posterior is None else posterior.functions()
        self._package = package_of(None if posterior is None else posterior.maps.example)
        parameters = signature(regressor.predict).parameters
        anything = any(each.kind == each.VAR_KEYWORD for each in parameters.values())
        if "return_std" not in parameters and not anything:
            raise TypeError(f"{type(regressor).__name__}.predict has no return_std, which a rollout needs.")
        # A regressor with **kwargs may pass them on to one that does not have include_noise.
        self._options = {"include_noise": noisy} if "include_noise" in parameters or self.functions else {}

    def predict(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and std (n, n_states)."""
        mean, std = self._asked(self.regressor.predict, X, return_std=True, **self._options)
        return self._checked(mean, len(X)), self._checked(std, len(X))

    def linearised(self, X: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean, its derivatives in X (n, n_states, D), and covariance Q (n, n_states, n_states) of a step."""
        # Deviations (n, D) are those of X. Finite differences, if needed, are taken over a share of them.
        mean, std = self.predict(X)
        if hasattr(self.regressor, "jacobian"):
            slopes = np.asarray(self._asked(self.regressor.jacobian, X)).reshape(*mean.shape, X.shape[1])
        else:
            slopes = _differences(lambda rows: self.predict(rows)[0], X, deviations)
        Q = std[:, :, np.newaxis] ** 2 * np.eye(self.n_states)
        return mean, slopes, Q if self.functions is None else Q + self.functions.between(X)

    def _asked(self, method: Callable[..., Any], X: np.ndarray, **options: Any) -> Any:
        """Call a method with rows [z, u], whose columns get the names that the regressor was fitted to."""
        rows = as_fitted(self.regressor, X, self._package)
        if rows is X and hasattr(self.regressor, "feature_names_in_"):
            # The data frame package is not installed, so that rows have no names.
            with ignored("X does not have valid feature names"):
                return method(rows, **options)
        return method(rows, **options)

    def _checked(self, values: Any, n: int) -> np.ndarray:
        found = np.asarray(values, dtype=float).reshape(n, -1)
        if found.shape[1] != self.n_states:
            raise ValueError(f"The regressor predicts {found.shape[1]} outputs, but z0 has {self.n_states} states.")
        return found


def _sampled(
    model: _OneStep, batch: np.ndarray, drive: _Drive, n_samples: int, rng: np.random.RandomState
) -> dict[str, np.ndarray]:
    functions, n_steps, n_states = model.functions, drive.n_steps, batch.shape[1]
    if functions is not None and len(functions.noise) != n_states:
        raise ValueError(f"The regressor predicts {len(functions.noise)} outputs, but z0 has {n_states} states.")
    of = np.repeat(np.arange(len(batch)), n_samples)
    paths, inputs = np.empty((len(of), n_steps, n_states)), np.empty((len(of), n_steps, drive.n_inputs))
    size = len(of) if functions is None else functions.at_once(n_steps)
    for first in range(0, len(of), size):
        own = slice(first, first + size)
        step = _steps(model, functions, len(of[own]), n_steps, rng)
        z = batch[of[own]]
        for t in range(n_steps):
            u = drive.at(t, z, of[own])
            z = _within_limits(step(np.hstack([z, u])), t, "particles")
            paths[own, t], inputs[own, t] = z, u
    samples = paths.reshape(len(batch), n_samples, n_steps, n_states)
    mean = samples.mean(axis=1)
    _warn_of_runaways(samples, batch)
    deviations = np.moveaxis(samples - mean[:, np.newaxis], 1, 3)  # (batch, steps, states, samples)
    covariance = deviations @ np.swapaxes(deviations, 2, 3) / (n_samples - 1)
    found = {"mean": mean, "std": np.sqrt(np.einsum("btii->bti", covariance)), "covariance": covariance}
    driven = inputs.reshape(len(batch), n_samples, n_steps, -1) if drive.inputs is None else drive.inputs
    return {**found, "samples": samples, "inputs": driven}


def _steps(
    model: _OneStep, functions: Any, n: int, n_steps: int, rng: np.random.RandomState
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from rows (n, D) to the next states of the particles."""
    if functions is None:

        def independent(X: np.ndarray) -> np.ndarray:
            mean, std = model.predict(X)
            return mean + std * rng.standard_normal(mean.shape)

        return independent
    g, deviation = functions.draw(n, n_steps, rng), np.sqrt(functions.noise) if model.noisy else None

    def consistent(X: np.ndarray) -> np.ndarray:
        values = g(X)
        return values if deviation is None else values + deviation * rng.standard_normal(values.shape)

    return consistent


def _fed_back(model: _OneStep, batch: np.ndarray, drive: _Drive, linearised: bool) -> dict[str, np.ndarray]:
    (n_batch, n_states), n_steps, of = batch.shape, drive.n_steps, np.arange(len(batch))
    mean, inputs = np.empty((n_batch, n_steps, n_states)), np.empty((n_batch, n_steps, drive.n_inputs))
    covariance = np.empty((n_batch, n_steps, n_states, n_states))
    z, Sigma = batch, np.zeros((n_batch, n_states, n_states))
    for t in range(n_steps):
        u = drive.at(t, z, of)
        X = np.hstack([z, u])
        if linearised:
            of_states = _deviations(Sigma)
            feedback = drive.slopes(t, z, of_states, of)
            of_inputs = _deviations(feedback @ Sigma @ np.swapaxes(feedback, 1, 2))
            following, slopes, Q = model.linearised(X, np.hstack([of_states, of_inputs]))
            A = slopes[:, :, :n_states] + slopes[:, :, n_states:] @ feedback
            Sigma = A @ Sigma @ np.swapaxes(A, 1, 2) + Q
        else:
            following, std = model.predict(X)
            Sigma = std[:, :, np.newaxis] ** 2 * np.eye(n_states)
        z = _within_limits(following, t)
        _within_limits(Sigma, t)
        mean[:, t], covariance[:, t], inputs[:, t] = z, Sigma, u
    std = np.sqrt(np.einsum("btii->bti", covariance))
    return {"mean": mean, "std": std, "covariance": covariance, "inputs": inputs}


def _drive(regressor: Any, batch: np.ndarray, given: ArrayLike | Controller, n_steps: int | None) -> _Drive:
    """Check the given inputs or controller."""
    n_states, columns = batch.shape[1], getattr(regressor, "n_features_in_", None)
    if columns is not None and columns < n_states:
        raise ValueError(
            f"z0 has {n_states} states, but rows of the regressor, [z, u], have n_features_in_={columns} columns."
        )
    if callable(given):
        if n_steps is None:
            raise ValueError("n_steps is needed with a controller.")
        check_integer(n_steps, "n_steps", minimum=1)
        if columns is None:
            raise ValueError("With a controller the regressor must have n_features_in_.")
        return _Drive(n_steps, columns - n_states, None, given)
    if n_steps is not None:
        raise ValueError("Pass n_steps only with a controller. The inputs determine the number of steps.")
    U = _finite(given, "U")
    n_inputs = columns - n_states if columns is not None else U.shape[-1]
    if U.ndim == 1 and n_inputs == 1:
        U = U[:, np.newaxis]
    shapes = f"(n_steps, {n_inputs}) or (n_batch, n_steps, {n_inputs}) with n_batch={len(batch)}"
    if U.ndim not in (2, 3) or U.shape[-1] != n_inputs or (U.ndim == 3 and len(U) != len(batch)):
        missing = U.ndim > 0 and U.shape[-1] == n_inputs - 1
        hint = ' If its features have dt="column", inputs are [u, Δt].' if missing else ""
        raise ValueError(f"U must be of shape {shapes}: rows of the regressor are [z, u]; got {U.shape}.{hint}")
    if U.shape[-2] == 0:
        raise ValueError(f"U has no steps: its shape is {U.shape}.")
    return _Drive(U.shape[-2], n_inputs, np.broadcast_to(U, (len(batch), *U.shape[-2:])), None)


def _finite(given: ArrayLike, name: str) -> np.ndarray:
    values = as_floats(given, name)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite; it contains {values[~np.isfinite(values)][0]}.")
    return values


def _within_limits(values: np.ndarray, t: int, of: str = "rollouts") -> np.ndarray:
    large = ~(np.abs(values) <= LARGEST).all(axis=tuple(range(1, values.ndim)))
    if large.any():
        raise ValueError(
            f"States of {large.sum()} of {len(values)} {of} grow beyond {LARGEST:g} at step {t}. {_REMEDY}"
        )
    return values


def _warn_of_runaways(samples: np.ndarray, starts: np.ndarray) -> None:
    """Warn if a few of the samples (n_batch, n_samples, n_steps, n_states) dominate the standard deviation."""
    # Particles that end in another stable state are also far from the others, but not far from the path so far.
    low, middle, high = np.percentile(samples, [25.0, 50.0, 75.0], axis=1)
    width = high - low
    path = np.maximum(np.abs(middle).max(axis=1), np.abs(starts))[:, np.newaxis]
    large = (samples.std(axis=1) > np.maximum(_RUNAWAY * width, _BEYOND * path)) & (width > 0.0)
    if large.any():
        step = int(np.flatnonzero(large.any(axis=(0, 2)))[0])
        far = np.abs(samples - middle[:, np.newaxis]) > _RUNAWAY * width[:, np.newaxis]
        count = int((far & large[:, np.newaxis]).any(axis=(2, 3)).sum())
        warn_user(
            f"{count} of {samples.shape[0] * samples.shape[1]} particles run away, the first at step {step}, and "
            f"dominate mean and std. Quantiles of samples describe the others. {_REMEDY} "
            'method="linearized" stays near the mean.',
            UnstableRolloutWarning,
        )


def _deviations(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (n, k) of covariances (n, k, k)."""
    return np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))


def _differences(function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return central differences (n, k, d) of function(rows) (n, k), for rows with deviations (n, d)."""
    # A small share of the deviations: the linear step has to be valid there, and rounding is small. Columns that do not
    # deviate contribute nothing, so that their derivatives are set to 0.
    step = np.where(deviations > 0.0, np.maximum(_SHARE * deviations, 256.0 * np.spacing(np.abs(rows))), 0.0)
    found = []
    for column in range(rows.shape[1]):
        shift = np.zeros_like(rows)
        shift[:, column] = step[:, column]
        width = np.where(step[:, column] > 0.0, 2.0 * step[:, column], 1.0)
        found.append((function(rows + shift) - function(rows - shift)) / width[:, np.newaxis])
    return np.stack(found, axis=2)

"""ContactMonitor detects contact of a robot, with a limited rate of false alarms."""

from __future__ import annotations

from copy import deepcopy
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_toeplitz
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted

from ..exceptions import warn_user
from ..utils.state import StatefulEstimator
from ..utils.validation import check_real, checked_groups, unchanged_if_it_fails
from .inverse_dynamics import InverseDynamics

# Durations of the pushes that the filters match, s. A filter covers this multiple of the longest one.
_PUSHES, _WINDOWS = (0.05, 0.15, 0.4), 2
# Alarms within this time count as one, s.
_APART = 1.0
# Share of the maxima of the statistic that its tail is fitted to, and their least number.
_TAIL, _FEWEST = 0.25, 8
# Free motion is too short if the threshold is larger than the largest statistic in it by this factor.
_FAR = 10.0
# White noise that is added to the variance of errors, as a share of it.
_WHITE = 1e-3


class ContactMonitor(StatefulEstimator):
    r"""Detect contact of a robot from the errors of predicted torques, with a limited rate of false alarms.

    Errors of predicted torques are correlated in time. So matched filters detect pushes s of 0.05 s, 0.15 s and 0.4 s
    on each joint:

    .. math::

        g = \frac{s^\top C^{-1} z}{\sqrt{s^\top C^{-1} s}}

    Here z are errors in predicted standard deviations, with the covariance C in free motion. A row raises an alarm if
    the largest :math:`|g|` over joints and pushes exceeds a threshold. The threshold follows from the largest values in
    free motion.

    Parameters
    ----------
    model : InverseDynamics
        Fitted model of the robot. `fit` copies it.
    dt : float, default=0.01
        Constant time between rows, s.
    false_alarms_per_hour : float, default=1.0
        Largest expected number of false alarms in an hour of free motion. Alarms within a second count as one.

    Attributes
    ----------
    threshold_ : float
        Rows with a larger statistic raise an alarm.
    scale_ : ndarray of shape (n_joints, 3)
        Root mean square of each g in free motion. The statistic is in these units.
    detectable_ : ndarray of shape (n_joints,)
        Torque of a push of 0.4 s that raises the statistic to the threshold, N m (N). A push twice as large is almost
        always detected.
    hours_ : float
        Duration of the free motion in `fit`, h.
    model_ : InverseDynamics
        Copy of the model. Fit the monitor again after `InverseDynamics.update` or another fit of the model.

    See Also
    --------
    InverseDynamics.check_log : Test whether a whole log fits the model.

    Notes
    -----
    Filter the signals in the same way as for the fit of the model. A filter without delay, as in
    `skevgp.datasets.load_log`, uses later rows. A causal filter delays alarms. There are no alarms in the first 0.8 s
    after a gap.

    References
    ----------
    - S. Haddadin, A. De Luca, A. Albu-Schäffer (2017): Robot Collisions: A Survey on Detection, Isolation, and
      Identification.
    - S. Coles (2001): An Introduction to Statistical Modeling of Extreme Values, chapter 4.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp import ContactMonitor, InverseDynamics
    >>> rng, t = np.random.default_rng(0), np.arange(0.0, 180.0, 0.01)
    >>> q, dq = np.sin(t) + 0.5 * np.sin(2.7 * t), np.cos(t) + 1.35 * np.cos(2.7 * t)
    >>> X = np.column_stack([q, dq, -np.sin(t) - 3.645 * np.sin(2.7 * t)])
    >>> y = X[:, 2] / 4 + 9.81 / 2 * np.sin(q) + 0.1 * rng.standard_normal(len(t))
    >>> model = InverseDynamics("pendulum", n_inducing=0).fit(X[:6000], y[:6000])
    >>> monitor = ContactMonitor(model).fit(X[6000:12000], y[6000:12000])
    >>> pushed = y[12000:] + 0.3 * (np.arange(6000) // 20 == 100)  # 0.3 N m for 0.2 s
    >>> alarms = monitor.predict(X[12000:], pushed)
    >>> bool(alarms[2000:2040].any()), int(alarms[:2000].sum())
    (True, 0)
    """

    _last: np.ndarray  # errors z of the last rows of a stream

    def __init__(self, model: InverseDynamics, *, dt: float = 0.01, false_alarms_per_hour: float = 1.0):
        self.model = model
        self.dt = dt
        self.false_alarms_per_hour = false_alarms_per_hour

    def fit(self, X: ArrayLike, y: ArrayLike, *, pieces: ArrayLike | None = None) -> Self:
        """Find the filters and the threshold from free motion.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈] of some minutes without contact, in the order of time. Use rows that the model was not
            fitted to.
        y : array-like of shape (n_samples, n_joints)
            Torques, in the units of the model.
        pieces : array-like of shape (n_samples,), default=None
            Label of the piece of each row. A piece is a part of the log without gaps.

        Returns
        -------
        self : ContactMonitor
            The fitted monitor.

        Raises
        ------
        ValueError, TypeError
            If an argument is out of its range, or the model is not an `InverseDynamics`. Also if the log, without the
            first 0.8 s of each piece, is shorter than 16 s.

        Warns
        -----
        ConvergenceWarning
            If the free motion is too short for ``false_alarms_per_hour``. The threshold is then more than 10 times the
            largest statistic.
        """
        if not isinstance(self.model, InverseDynamics):
            raise TypeError(f"model must be a fitted InverseDynamics; got {type(self.model).__name__}.")
        check_is_fitted(self.model)
        with unchanged_if_it_fails(self):
            self._fit(X, y, pieces)
        return self

    def _fit(self, X: ArrayLike, y: ArrayLike, pieces: ArrayLike | None) -> None:
        step = check_real(self.dt, "dt", minimum=0.0, strict=True)
        rate = check_real(self.false_alarms_per_hour, "false_alarms_per_hour", minimum=0.0, strict=True)
        self.model_ = deepcopy(self.model)
        z, std, runs = self._errors(X, y, pieces)
        parts = [z[runs == run] for run in np.unique(runs)]
        self._lengths = [max(1, round(push / step)) for push in _PUSHES]
        self._window = _WINDOWS * self._lengths[-1]
        parts = [part for part in parts if len(part) >= self._window]
        self._filters = np.stack([self._matched(products) for products in self._covariances(parts, z.shape[1])])
        filtered = [self._filtered(part) for part in parts]
        block = max(1, round(_APART / step))
        judged = sum(len(one) for one in filtered)
        if judged < 2 * _FEWEST * block:
            raise ValueError(
                f"fit needs at least {2 * _FEWEST * _APART:g} s of free motion, without the first "
                f"{self._window * step:.3g} s of each piece; got {judged * step:.3g} s ({judged} rows)."
            )
        together = np.concatenate(filtered)
        scale = np.sqrt(np.mean(together**2, axis=0))
        self.scale_ = np.where(scale > 0.0, scale, 1.0)
        maxima = np.concatenate([_maxima(np.abs(one / self.scale_).max(axis=(1, 2)), block) for one in filtered])
        self.hours_ = judged * step / 3600.0
        self.threshold_ = _threshold(maxima, rate * self.hours_)
        gain = np.abs(self._filters[:, -1, -self._lengths[-1] :].sum(axis=1)) / self.scale_[:, -1]
        self.detectable_ = self.threshold_ * np.sqrt(np.mean(std**2, axis=0)) / gain
        self.reset()
        if self.threshold_ > _FAR * maxima.max():
            torques = ", ".join(f"{torque:.3g}" for torque in self.detectable_)
            warn_user(
                f"{3600.0 * self.hours_:.0f} s of free motion are too short for false_alarms_per_hour={rate:g}. The "
                f"threshold is {self.threshold_ / maxima.max():.0f} times the largest statistic of this motion. So "
                f"only pushes above detectable_ = [{torques}] raise an alarm. Record more free motion, or raise "
                "false_alarms_per_hour.",
                ConvergenceWarning,
            )

    def score_samples(self, X: ArrayLike, y: ArrayLike, *, pieces: ArrayLike | None = None) -> np.ndarray:
        """Return the statistic of each row.

        Parameters
        ----------
        X, y, pieces : array-like
            A log, as in `fit`.

        Returns
        -------
        statistic : ndarray of shape (n_samples,)
            Largest absolute value of g / ``scale_`` over joints and pushes. It is 0 in the first 0.8 s of each piece.
        """
        check_is_fitted(self)
        z, _, runs = self._errors(X, y, pieces)
        found = np.zeros(len(z))
        for run in np.unique(runs):
            rows = np.flatnonzero(runs == run)
            if len(rows) >= self._window:
                found[rows[self._window - 1 :]] = np.abs(self._filtered(z[rows]) / self.scale_).max(axis=(1, 2))
        return found

    def predict(self, X: ArrayLike, y: ArrayLike, *, pieces: ArrayLike | None = None) -> np.ndarray:
        """Return whether each row raises an alarm.

        Parameters
        ----------
        X, y, pieces : array-like
            A log, as in `fit`.

        Returns
        -------
        alarms : ndarray of bool of shape (n_samples,)
            Whether the statistic of the row is above the threshold. The statistic does not depend on later rows.
        """
        return self.score_samples(X, y, pieces=pieces) > self.threshold_

    def step(self, x: ArrayLike, y: ArrayLike) -> bool:
        """Add a row to the stream, and return whether it raises an alarm.

        Parameters
        ----------
        x : array-like of shape (3 * n_joints,)
            Row [q, q̇, q̈].
        y : array-like of shape (n_joints,)
            Torques.

        Returns
        -------
        alarm : bool
            Whether the row raises an alarm. `predict` gives the same alarm with all rows since `reset`.
        """
        check_is_fitted(self)
        z, _, _ = self._errors(np.atleast_2d(np.asarray(x)), np.atleast_2d(np.asarray(y)), None)
        self._last = np.concatenate([self._last, z])[-self._window :]
        if len(self._last) < self._window:
            return False
        return bool(np.abs(self._filtered(self._last) / self.scale_).max() > self.threshold_)

    def reset(self) -> None:
        """Forget the rows of the stream, for example after a gap."""
        check_is_fitted(self)
        self._last = np.zeros((0, len(self._filters)))

    def _errors(
        self, X: ArrayLike, y: ArrayLike, pieces: ArrayLike | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return errors (n, o) in predicted std, the std (n, o), and labels (n,) of pieces without gaps."""
        rows, targets = self.model_._new_log(X, y)
        mean, std = self.model_.predict(rows, return_std=True)
        std = std.reshape(targets.shape)
        runs = checked_groups(pieces, len(rows), "pieces")
        z = (targets - mean.reshape(targets.shape)) / std
        return z, std, np.zeros(len(rows), dtype=int) if runs is None else runs

    def _covariances(self, parts: list[np.ndarray], n_joints: int) -> np.ndarray:
        """Return the autocovariance of each joint, (o, window)."""
        found = np.zeros((n_joints, self._window))
        for part in parts:
            wave = np.fft.rfft(part, 2 * len(part), axis=0)
            found += np.fft.irfft(wave * wave.conj(), 2 * len(part), axis=0)[: self._window].T
        found /= max(1, sum(map(len, parts)))
        found[:, 0] = np.where(found[:, 0] > 0.0, (1.0 + _WHITE) * found[:, 0], 1.0)
        return found

    def _matched(self, covariance: np.ndarray) -> np.ndarray:
        """Return the filters (pushes, window) of a joint, latest row last."""
        filters = []
        for length in self._lengths:
            push = np.zeros(self._window)
            push[-length:] = 1.0
            solved = solve_toeplitz(covariance, push)
            filters.append(solved / np.sqrt(push @ solved))
        return np.array(filters)

    def _filtered(self, z: np.ndarray) -> np.ndarray:
        """Return g of rows (n, o) from the first full window on, (n - window + 1, o, pushes)."""
        windows = np.lib.stride_tricks.sliding_window_view(z, self._window, axis=0)
        found: np.ndarray = np.einsum("now,opw->nop", windows, self._filters, optimize=True)
        return found


def _maxima(values: np.ndarray, block: int) -> np.ndarray:
    """Return the maximum of each block of rows."""
    return np.array([part.max() for part in np.array_split(values, max(1, len(values) // block))])


def _threshold(maxima: np.ndarray, wanted: float) -> float:
    """Return the level that the wanted number of maxima is expected to exceed."""
    # Excesses over a high level are nearly exponential (Coles 2001, chapter 4). Logarithms of the maxima give a heavier
    # tail, and the mean excess is increased by its standard error, because later free motion may be of another kind.
    if wanted >= _TAIL * len(maxima):  # the level is within the maxima
        return float(np.quantile(maxima, max(0.0, 1.0 - wanted / len(maxima))))
    count = min(len(maxima) - 1, max(_FEWEST, round(_TAIL * len(maxima))))
    largest = np.sort(np.log(np.maximum(maxima, 1e-300)))[::-1]
    level, excess = largest[count], float(np.mean(largest[:count] - largest[count])) * (1.0 + count**-0.5)
    return float(np.exp(level + excess * max(0.0, np.log(count / wanted))))

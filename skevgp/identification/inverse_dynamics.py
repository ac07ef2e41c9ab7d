"""InverseDynamics: joint torques with credible intervals, and a posterior over masses and friction, from logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Self

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import ArrayLike
from sklearn.base import RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import Bunch, Tags, check_random_state
from sklearn.utils.validation import check_is_fitted

from ..estimators.summary import ModelSummary, html_of, of_inverse_dynamics
from ..exceptions import RobotModelWarning, ignored, warn_user
from ..features import RigidBodyRegressor
from ..features.robot_map import joints_named
from ..robots import nearest_consistent
from ..robots.loading import Robot
from ..utils.frames import FrameColumns
from ..utils.shapes import like_y
from ..utils.sklearn import Interval, StrOptions, fit_context
from ..utils.validation import check_magnitude, check_not_vanishing, check_real, unchanged_if_it_fails, validate_numbers
from .identified_robot import IdentifiedRobot
from .joint_residual import JointResidual, fit_joint_residual
from .likely_causes import likely_causes
from .log_check import check_of
from .moves import FEWEST_MOVES, MoveEffects, of_move
from .rows_of_logs import evenly_spread
from .weaknesses import weaknesses
from .weights import Fold, Rows, condensed, folds

# Weights that differ from their prior by more prior standard deviations than this make the prior doubtful.
_FAR = 4.0
# Physics explains hardly anything if its residual has more than this share of the variance of a torque.
_LITTLE = 0.5
# Above this share, columns may be in another order, or in degrees.
_DOUBTFUL = 0.1
# Limits of torques. Their variances, and the ratios of these to noise variances, neither vanish nor overflow.
_SMALLEST_TORQUE, _LARGEST_TORQUE = 1e-105, 1e40
# Largest speed below which rows count less for f_j. Filters blur the sign of friction above it too, but f_j learns the
# average friction there.
_SHARP = 0.01


class InverseDynamics(RegressorMixin, IdentifiedRobot):
    r"""Joint torques of a robot, its masses and its friction from logs, with their uncertainty.

    .. math::

        \tau_j = (1 + c_j) \, Y_j(q, \dot q, \ddot q)\,\pi + F_j(\dot q, \ddot q)\,\varphi + a_j f_j(x_j)
        + z_j^\top d_j + \varepsilon_j

    The weights β = (π, φ) of `RigidBodyRegressor` are common to all joints, and have the robot's model as prior mean.
    The c are errors of the motors' gains, if these are not known. Each f_j is a sparse Gaussian process
    (`EVGPRegressor`) of the residual torque of joint j. Its inputs are those of the joint, :math:`x_j = (q_j, \dot q_j,
    \ddot q_j, \hat\tau_j)`, with the torque :math:`\hat\tau_j` by the weights, because friction of gears depends on
    load and speed. Moves that were left out decide how much it counts, by the share a_j from 0 to 1. The d_j are
    offset, friction and gain of a move, which differ from day to day. The noise is larger at low speeds, where the sign
    of Coulomb friction is not known. See :doc:`/guide/torques`.

    Parameters
    ----------
    robot : RigidBodyRegressor, str, path-like, System, pinocchio.Model or None, default=None
        Approximate model of the robot, such as a URDF with inaccurate masses. Pass a `RigidBodyRegressor` to set
        friction and prior scales. If None, each output has a linear model and a Gaussian process of all columns.
    gain_scale : float, default=0.0
        Prior standard deviation of the relative error of each joint's gain: for example 0.1 if y are currents times
        gains of a catalogue, and 0 if y are torques. It mostly affects masses and their intervals.
    consistent : bool, default=False
        Whether to move the weights to the most probable physical ones (masses above 0, positive definite
        pseudo-inertias). Covariances and noise do not change.
    stiction_velocity : "auto" or None, default="auto"
        If ``"auto"``, find the velocity v_s of the mean friction :math:`F \tanh(\dot q / v_s)` of each joint with its
        uncertainty (``theta_``). If None, use that of `RigidBodyRegressor`.
    learn_scales : bool, default=True
        Whether to learn a factor for the prior standard deviations of each group of weights: inertial parameters, and
        each kind of friction (`RigidBodyRegressor.coef_groups`). A machine that is much heavier than its model needs
        it. Factors are from 1e-4 to 1e4. With ``gain_scale``, that of inertial parameters is at least 1: torques do
        not show a common error of masses and gains.
    n_inducing : int, default=40
        Number of inducing points of each f_j. With 0 there are no f_j.
    max_rows : int, default=3000
        Number of evenly spread rows that each f_j is fitted to. Weights are fitted to all rows.
    max_iter : int or None, default=None
        Maximum number of iterations, as in `EVGPRegressor`.
    n_jobs : int or None, default=None
        Number of joints that are fitted in parallel, in threads; None means 1, -1 all cores.
    random_state : int, RandomState instance or None, default=None
        Seed of the inducing points.

    Attributes
    ----------
    coef_, coef_std_ : ndarray of shape (n_h,)
        Posterior means and standard deviations of β, in the order of ``coef_names_``.
    coef_cov_ : ndarray of shape (n_h, n_h)
        Posterior covariance of β.
    coef_names_ : ndarray of str of shape (n_h,)
        Names of the weights: m(q1), mcx(q1), ..., viscous(q1), ...
    coef_prior_mean_, coef_prior_scale_ : ndarray of shape (n_h,)
        Prior means and learned prior standard deviations of β. Torques do not determine a weight whose standard
        deviation is still that of the prior.
    theta_, theta_std_ : dict of str to float
        Posterior medians of the v_s of mean friction :math:`F \tanh(\dot q / v_s)`, rad/s or m/s, and their standard
        deviations to first order, such as ``theta_["stiction_velocity(q1)"]``. Empty if they are not found.
    gains_, gains_std_ : ndarray of shape (n_outputs,)
        Gains 1 + c and their standard deviations. Torques of the model times gains are those of y.
    noise_variance_ : ndarray of shape (n_outputs,)
        Noise variance σ² of moving joints.
    standing_std_ : ndarray of shape (n_outputs,)
        Additional standard deviation by friction at rest.
    residual_std_ : ndarray of shape (n_outputs,)
        Prior standard deviation of each a_j f_j, or 0 if there is none.
    residual_models_ : list of EVGPRegressor or None
        The models f_j, before their means fade. None where left-out moves do not confirm one.
    residual_share_ : ndarray of shape (n_outputs,)
        The a_j.
    correlation_time_ : ndarray of shape (n_outputs,)
        Number of rows that contain as much information on the weights as an independent row.
    inflation_ : float
        Factor by which groups differ more from each other than ``correlation_time_`` explains, at least 1. The
        information of all rows is divided by it.
    stiction_velocity_ : ndarray of shape (n_outputs,)
        Speed below which the sign of friction is not known, rad/s or m/s.
    move_scale_ : ndarray of shape (n_outputs, 4)
        Standard deviations between moves: of the offset, of viscous friction, of Coulomb friction and of the relative
        error of the gain. With few moves they are larger than those that were seen.
    move_ : ndarray of shape (n_outputs, 4)
        These effects in the move that `update` was given, else 0.
    n_iter_ : int
        Largest number of iterations of an f_j.
    feature_map_ : transformer
        Fitted `RigidBodyRegressor`.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it had any.

    See Also
    --------
    skevgp.datasets.load_log : Read positions, velocities, accelerations and torques of a log.
    skevgp.features.RigidBodyRegressor : Features and their prior.
    EVGPRegressor : With ``feature_map=RigidBodyRegressor(robot)``, the same model without its treatment of logs.

    Notes
    -----
    Weights are fitted first by Bayesian regression, together with noise, static friction, its velocities and gains.
    Filtered rows count less than independent ones (``correlation_time_``, ``inflation_``). The :math:`\hat\tau` of a
    training row is predicted from other groups or blocks of rows, so that y is not used twice. Each f_j is at most as
    large as the residuals, and its length scales are at most three standard deviations of their column and, except that
    of the speed, at least one. Groups, or blocks of rows if there are fewer than three groups, are left out in turn.
    Weights and f_j are then fitted again. The a_j has the least error on them; it is 0 unless a t-test at 5 % says that
    errors fall. Noise and variances of d_j are those of left-out rows. Far from the training rows the mean of f_j
    fades. Memory is a few times 8 bytes times n_samples * n_outputs * n_h.

    References
    ----------
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, sections 2.1 and 2.7.
    - C. J. Geyer (1992): Practical Markov Chain Monte Carlo. Statistical Science.

    Examples
    --------
    Identify a pendulum with friction from a perturbed model:

    >>> import numpy as np
    >>> from skevgp import InverseDynamics
    >>> from skevgp.datasets import load_robot, perturb_robot
    >>> from skevgp.features import RigidBodyRegressor
    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> q = np.sin(t) + 0.5 * np.sin(2.7 * t)
    >>> dq = np.gradient(q, t)
    >>> X = np.column_stack([q, dq, np.gradient(dq, t)])
    >>> torque = X[:, 2] / 4 + 9.81 / 2 * np.sin(q) + 0.1 * dq + 0.3 * np.tanh(dq / 0.01)
    >>> y = torque + 0.05 * np.random.default_rng(0).standard_normal(len(t))
    >>> model = InverseDynamics(perturb_robot("pendulum", random_state=0), random_state=0).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 3)
    1.0
    >>> weights = dict(zip(model.coef_names_, model.coef_.round(2)))
    >>> float(abs(weights["coulomb(q)"])), float(weights["viscous(q)"])
    (0.3, 0.1)
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "robot": "no_validation",
        "gain_scale": [Interval(Real, 0, None, closed="left")],
        "consistent": ["boolean"],
        "stiction_velocity": [StrOptions({"auto"}), None],
        "learn_scales": ["boolean"],
        "n_inducing": [Interval(Integral, 0, None, closed="left")],
        "max_rows": [Interval(Integral, 10, None, closed="left")],
        "max_iter": [Interval(Integral, 0, None, closed="left"), None],
        "n_jobs": [Integral, None],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        robot: RigidBodyRegressor | Robot | None = None,
        *,
        gain_scale: float = 0.0,
        consistent: bool = False,
        stiction_velocity: Literal["auto"] | None = "auto",
        learn_scales: bool = True,
        n_inducing: int = 40,
        max_rows: int = 3000,
        max_iter: int | None = None,
        n_jobs: int | None = None,
        random_state: int | np.random.RandomState | None = None,
    ):
        self.robot = robot
        self.gain_scale = gain_scale
        self.consistent = consistent
        self.stiction_velocity = stiction_velocity
        self.learn_scales = learn_scales
        self.n_inducing = n_inducing
        self.max_rows = max_rows
        self.max_iter = max_iter
        self.n_jobs = n_jobs
        self.random_state = random_state

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    @fit_context(prefer_skip_nested_validation=False)
    def fit(
        self, X: ArrayLike, y: ArrayLike, *, groups: ArrayLike | None = None, pieces: ArrayLike | None = None
    ) -> Self:
        """Fit weights, noise and residuals.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈] in the order of time, in rad, rad/s and rad/s² (m, m/s and m/s² for prismatic joints).
        y : array-like of shape (n_samples, n_joints) or, of one joint, (n_samples,)
            Torques in N m (N), or with ``gain_scale`` currents times gains of a catalogue. Up to 1e40, and the largest
            of a column must be 0 or above 1e-105.
        groups : array-like of shape (n_samples,), default=None
            Labels of the move (trajectory) of each row. Credible intervals for new moves need at least three of them,
            each with less than four fifths of the rows. Otherwise blocks of rows are used.
        pieces : array-like of shape (n_samples,), default=None
            Labels of rows that follow each other without a gap, such as ``load_log(...).pieces``. If None, the rows of
            a group have no gaps.

        Returns
        -------
        self : InverseDynamics
            The estimator itself, fitted.

        Raises
        ------
        ImportError
            If Pinocchio is needed and not installed.
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, shapes do not fit, or X or y is a data frame
            with the robot's joints in another order.

        Warns
        -----
        ConvergenceWarning
            If weights are far from the robot's model, for example because y has other units. If columns seem to be in
            another order, angles in degrees, or positions beyond the limits of the model. If a joint never moves, or
            has hardly any torque, or rows tell too little about the weights.
        RobotModelWarning
            If the model of the robot is unphysical, as in `skevgp.datasets.load_robot`.
        """
        with unchanged_if_it_fails(self):
            doubts = self._fit(X, y, groups, pieces)
        for doubt in doubts:
            warn_user(doubt, ConvergenceWarning)
        return self

    def _fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None, pieces: ArrayLike | None) -> list[str]:
        """Fit, and return warnings about the robot's model and the data."""
        rows_x: np.ndarray
        rows_x, targets = validate_numbers(self, X, y, reset=True, dtype=np.float64, ensure_min_samples=2)
        targets = np.asarray(targets, dtype=np.float64)
        self._one_dimensional = targets.ndim == 1
        targets = targets.reshape(len(targets), -1)
        check_magnitude(rows_x, "X")
        check_magnitude(targets, "y", _LARGEST_TORQUE)
        check_not_vanishing(np.abs(targets).max(axis=0), "y", _SMALLEST_TORQUE)
        self.feature_map_ = self._map().fit(X)  # checks the order of a data frame's columns
        self._check_columns_of_y(y)
        with ignored(category=RobotModelWarning):  # given already
            self.feature_map_ = self._map().fit(rows_x)
        rows = self._find_weights(rows_x, targets, groups, pieces)
        self._n_moves = rows.n_moves
        if self.consistent and self._has_robot:
            size = 10 * targets.shape[1]
            start, covariance = self._weights.mean[:size], self._weights.covariance[:size, :size]
            self._weights = self._weights.given(nearest_consistent(start.reshape(-1, 10), covariance).ravel())
        self._outputs = self._output_names(targets.shape[1])
        variance = targets.var(axis=0)
        missed = np.array([noise.variance for noise in self._weights.noise])
        little = (missed > _LITTLE * variance) & (variance > 0.0)
        self._unexplained = [name for name, bad in zip(self._outputs, little, strict=True) if bad]
        is_doubtful = ((missed > _DOUBTFUL * variance) & (variance > 0.0)).any()
        doubts = []
        if self._has_robot:
            doubts = [doubt] if (doubt := self._doubt(rows_x, targets, is_doubtful)) else []
            doubts += weaknesses(rows, self._weights, len(self._names(targets.shape[1])), self._outputs)
        self._joints = self._residuals(rows_x, rows)
        self._known = condensed(rows, self._weights, self._effects(self._weights.predict(rows.features), rows.speed))
        self._set_attributes()
        return doubts

    def _doubt(self, X: np.ndarray, y: np.ndarray, is_doubtful: bool | np.bool_) -> str:
        """Return a warning if the robot's model explains torques badly, or ""."""
        is_far = self._weights.surprise > _FAR or bool(self._unexplained)
        causes: list[str] = []
        if is_far or is_doubtful:
            prior, size = self._weights.prior, len(self._names(y.shape[1]))
            own = prior.mean[:size], prior.covariance[:size, :size]
            causes = likely_causes(self.feature_map_, X, y, own, is_far=is_far)
        if not is_far and not causes:
            return ""
        named = "".join(f"{cause}. " for cause in causes) + ("Otherwise, its" if causes else "its")
        little = f"; of {self._unexplained} hardly anything is explained" if self._unexplained else ""
        return (
            f"The robot's model is far from what torques say: {named} masses may be placeholders, "
            f"or y in other units. Give {'' if self.learn_scales else 'RigidBodyRegressor wider scales, or '}y in N m. "
            f"(Weights moved by {self._weights.surprise:.1f} prior standard deviations{little}.)"
        )

    def _check_columns_of_y(self, y: ArrayLike) -> None:
        """Raise ValueError for a data frame with the robot's joints in another order."""
        frame = FrameColumns.of(y) if self._has_robot else None
        if frame is not None:
            joints = self._output_names(len(frame.names))
            found = joints_named(frame.names, joints)
            if found is not None and found != joints and sorted(found) == sorted(joints):
                raise ValueError(f"The columns of y must be in the robot's order {joints}; got {frame.names}.")

    def _residuals(self, X: np.ndarray, rows: Rows) -> list[JointResidual]:
        weights, y = self._weights, rows.targets
        parts = folds(rows, weights)
        guessed = np.empty_like(y)
        for part in parts:
            guessed[part.out] = part.torques[part.out]
        residual = y - weights.predict(rows.features)
        some = evenly_spread(len(y), self.max_rows)
        seed = check_random_state(self.random_state).randint(np.iinfo(np.int32).max)
        options = {"n_inducing": self.n_inducing, "max_iter": self.max_iter, "random_state": seed}
        smooth = np.array([True, False, True, True]) if self._has_robot else np.zeros(X.shape[1], dtype=bool)
        fits = (
            delayed(fit_joint_residual)(
                self._own(X, guessed, j),
                residual[:, j],
                [Fold(part.out, part.torques[:, j], part.variance[:, j]) for part in parts],
                y[:, j],
                rows,
                rows.speed[:, j],
                weights.noise[j],
                min(float(velocity), _SHARP),
                some,
                smooth,
                **options,
            )
            for j, velocity in enumerate(weights.prior.velocity)
        )
        return Parallel(n_jobs=self.n_jobs, prefer="threads")(fits)

    def _set_attributes(self) -> None:
        weights, n_outputs = self._weights, len(self._joints)
        p, n = len(self._names(n_outputs)), weights.n_weights
        std = np.sqrt(np.maximum(np.diag(weights.covariance), 0.0))
        self.coef_, self.coef_std_, self.coef_cov_ = weights.mean[:p], std[:p], weights.covariance[:p, :p]
        self.coef_names_ = self._names(n_outputs)
        self.theta_, self.theta_std_ = ({}, {}) if self._theta is None else self._theta.attributes()[:2]
        self.coef_prior_mean_ = weights.prior.mean[:p]
        self.coef_prior_scale_ = np.sqrt(np.diag(weights.prior.covariance)[:p])
        self.gains_ = weights.gains(n_outputs)
        self.gains_std_ = std[n:] if len(std) > n else np.zeros(n_outputs)
        noise = [joint.noise for joint in self._joints]
        self.noise_variance_ = np.array([one.variance for one in noise])
        self.standing_std_ = np.array([one.coulomb / np.sqrt(3.0) for one in noise])
        self.residual_std_ = np.array([joint.signal for joint in self._joints])
        self.residual_share_ = np.array([joint.share for joint in self._joints])
        self.residual_models_ = [joint.model for joint in self._joints]
        self.move_scale_ = np.sqrt([np.diag(joint.effects.covariance) for joint in self._joints])
        self.move_ = np.zeros_like(self.move_scale_)
        self.n_iter_ = max([1, *(model.n_iter_ for model in self.residual_models_ if model is not None)])
        self.correlation_time_ = weights.correlation_time
        self.inflation_ = weights.inflation
        self.stiction_velocity_ = np.array([one.velocity for one in noise])

    def predict(
        self, X: ArrayLike, return_std: bool = False, include_noise: bool = True
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Predict torques.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈].
        return_std : bool, default=False
            Whether to return the standard deviation too.
        include_noise : bool, default=True
            Whether standard deviations are those of measured torques, with noise.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_joints)
            Mean of the torques, in the units of y.
        std : ndarray of the same shape
            Standard deviation of the torques. Only if ``return_std``.
        """
        check_is_fitted(self)
        rows: np.ndarray = validate_numbers(self, X, reset=False, dtype=np.float64)
        check_magnitude(rows, "X")
        features, speed = self._features(rows, len(self._joints)), self._speed(rows, len(self._joints))
        moves = [joint.move for joint in self._joints]
        mean, variance = self._moments(rows, features, speed, moves)
        if not return_std:
            return self._like_y(mean)
        variance += self._weights.variance(features)
        if include_noise:
            variance += self._noise(speed)
        return self._like_y(mean), self._like_y(np.sqrt(variance))

    def _moments(
        self, X: np.ndarray, features: np.ndarray, speed: np.ndarray, moves: list[MoveEffects]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of torques, and the variance by f_j and effects of moves, (n, o) each."""
        physics = self._weights.predict(features)
        mean, variance = physics.copy(), np.zeros_like(physics)
        for j, (joint, move, z) in enumerate(zip(self._joints, moves, self._terms(physics, speed), strict=True)):
            for more, uncertain in (joint.moments(self._own(X, physics, j)), move.moments(z)):
                mean[:, j] += more
                variance[:, j] += uncertain
        return mean, variance

    def _noise(self, speed: np.ndarray) -> np.ndarray:
        """Return the variance of the noise, (n, o)."""
        return np.column_stack([joint.noise.of(v) for joint, v in zip(self._joints, speed.T, strict=True)])

    def _like_y(self, values: np.ndarray) -> np.ndarray:
        return like_y(values) if self._one_dimensional else values

    def update(self, X: ArrayLike, y: ArrayLike, *, pieces: ArrayLike | None = None) -> Self:
        """Adapt to the machine of today by some rows of a new log.

        Friction changes with temperature, and sensors drift. Each joint has an offset, viscous friction, Coulomb
        friction and gain of its own in each move, whose variances `fit` finds by left-out moves (``move_scale_``). A
        few seconds of a new log determine them. Weights and f_j stay. A joint stays as it is if updates by the first
        third of left-out moves did not lower the errors of the rest.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈] in the order of time.
        y : array-like of shape (n_samples, n_joints) or, of one joint, (n_samples,)
            Torques, in the units of `fit`.
        pieces : array-like of shape (n_samples,), default=None
            Labels of rows that follow each other without a gap, as in `fit`.

        Returns
        -------
        self : InverseDynamics
            The estimator itself. Predictions are those of the move of X. Another call replaces this one.

        Raises
        ------
        ValueError, TypeError
            If shapes do not fit, data are not finite, or `fit` had fewer than three ``groups``.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> rng = np.random.default_rng(0)
        >>> X, day = rng.normal(size=(900, 3)), np.arange(900) // 100
        >>> torque = X[:, 2] / 4 + 9.81 / 2 * np.sin(X[:, 0]) + 0.1 * rng.normal(size=900)
        >>> drift = 0.03 * rng.normal(size=9)
        >>> model = InverseDynamics("pendulum", n_inducing=0).fit(X, torque + drift[day], groups=day)
        >>> before = np.mean(torque + 0.05 - model.predict(X))
        >>> after = np.mean(torque + 0.05 - model.update(X[:100], torque[:100] + 0.05).predict(X))
        >>> bool(abs(after) < 0.5 * abs(before))
        True
        """
        rows, missed, _, z = self._errors_of(X, y, pieces, "update")
        for j, joint in enumerate(self._joints):
            if joint.update is not None:
                move = of_move(joint.update, z[j], missed[:, j], rows.speed[:, j], joint.noise, rows.runs)
                self._joints[j] = replace(joint, move=move)
        self.move_ = np.array([joint.move.mean for joint in self._joints])
        return self

    def check_log(
        self,
        X: ArrayLike,
        y: ArrayLike,
        *,
        pieces: ArrayLike | None = None,
        dt: float = 0.01,
        false_alarms_per_minute: float = 0.01,
    ) -> Bunch:
        """Test whether a log fits the model, without another load, a fault or contact.

        Errors of the log are compared with errors of left-out moves at `fit`, by their mean square and by the offset,
        friction and gain that explain them. `update` does not count.

        Parameters
        ----------
        X, y, pieces : array-like
            The log, as in `update`.
        dt : float, default=0.01
            Time between rows, s.
        false_alarms_per_minute : float, default=0.01
            Expected false alarms per minute of log, for logs without a fault.

        Returns
        -------
        check : Bunch
            - ``fits`` : bool, whether the log fits;
            - ``p_value`` : float, probability that an ordinary log fits as badly or worse;
            - ``p_values`` : ndarray of shape (n_joints,), the same for each joint alone;
            - ``joints`` : list of str, joints that do not fit.

        Raises
        ------
        ValueError, TypeError
            If shapes do not fit, data are not finite, an argument is out of its range, or `fit` had fewer than three
            ``groups``.

        Notes
        -----
        With few moves at `fit`, only large faults are found.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> rng = np.random.default_rng(0)
        >>> X, day = rng.normal(size=(900, 3)), np.arange(900) // 100
        >>> torque = X[:, 2] / 4 + 9.81 / 2 * np.sin(X[:, 0]) + 0.1 * rng.normal(size=900)
        >>> model = InverseDynamics("pendulum", n_inducing=0).fit(X, torque, groups=day)
        >>> model.check_log(X[:300], torque[:300]).fits, model.check_log(X[:300], 1.1 * torque[:300]).joints
        (True, ['q'])
        """
        step = check_real(dt, "dt", minimum=0.0, strict=True)
        rate = check_real(false_alarms_per_minute, "false_alarms_per_minute", minimum=0.0, strict=True)
        rows, missed, std, z = self._errors_of(X, y, pieces, "check_log")
        probability = min(0.5, rate * len(missed) * step / 60.0)
        return check_of(self._joints, self._outputs, missed, std, z, rows.runs, probability)

    def _errors_of(
        self, X: ArrayLike, y: ArrayLike, pieces: ArrayLike | None, method: str
    ) -> tuple[Rows, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return the rows of a new log, errors and std (n, o) for a move without training rows, and z of joints."""
        check_is_fitted(self)
        if self._n_moves < FEWEST_MOVES:
            raise ValueError(
                f"{method} compares moves. Fit with at least {FEWEST_MOVES} groups; the number was {self._n_moves}."
            )
        rows_x, targets = self._new_log(X, y)
        rows = self._as_rows(rows_x, targets, None, pieces)
        moves = [joint.effects for joint in self._joints]
        mean, variance = self._moments(rows_x, rows.features, rows.speed, moves)
        variance += self._weights.variance(rows.features) + self._noise(rows.speed)
        z = self._terms(self._weights.predict(rows.features), rows.speed)
        return rows, targets - mean, np.sqrt(variance), z

    def summary(self) -> ModelSummary:
        """Summarise the fit: weights with their prior, noise, and the residual of each joint.

        Returns
        -------
        summary : ModelSummary
            Object that prints as text, shows as tables in notebooks, and has ``to_frame()``.
        """
        check_is_fitted(self)
        return of_inverse_dynamics(self, self._outputs)

    @property
    def _repr_html_(self) -> Callable[[], str]:
        # The attribute exists only if scikit-learn's option ``display`` is "diagram".
        diagram: Callable[[], str] = super()._repr_html_
        return lambda: diagram() + html_of(self)

    def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, str]:
        bundle: dict[str, str] = super()._repr_mimebundle_(**kwargs)
        if "text/html" in bundle:
            bundle["text/html"] += html_of(self)
        return bundle

"""InverseDynamics learns joint torques, masses and friction from logs, with credible intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from ..utils.validation import (
    as_floats,
    check_magnitude,
    check_not_vanishing,
    check_real,
    unchanged_if_it_fails,
    validate_numbers,
)
from .identified_robot import IdentifiedRobot
from .joint_residual import JointResidual, fit_joint_residual
from .likely_causes import likely_causes
from .log_check import check_of
from .moves import EFFECTS, FEWEST_MOVES, MoveEffects, of_move
from .rows_of_logs import evenly_spread
from .weaknesses import weaknesses
from .weights import Fold, Rows, condensed, folds

# If weights differ from their prior by more prior standard deviations than this, `fit` warns about the prior.
_FAR = 4.0
# Physics explains little of a torque if the residual has more than this share of its variance.
_LITTLE = 0.5
# Above this share, `fit` tests whether columns are in another order or in degrees.
_DOUBTFUL = 0.1
# Number of weights that a warning names.
_MOST_NAMED = 3
# Limits of torques. Between them, variances and their ratios to noise variances neither vanish nor overflow.
_SMALLEST_TORQUE, _LARGEST_TORQUE = 1e-105, 1e40
# Rows below the speed v_s count less for f_j, and v_s is at most this value. Filters also blur the sign of friction at
# higher speeds, but there f_j learns the average friction.
_SHARP = 0.01
# Largest prior standard deviation of effects of moves, in units of friction and of the gain.
_LARGEST_MOVE_SCALE = 1e6


class InverseDynamics(RegressorMixin, IdentifiedRobot):
    r"""Joint torques, masses and friction of a robot from its logs, with their uncertainty.

    .. math::

        \tau_j = (1 + c_j) \, Y_j(q, \dot q, \ddot q)\,\pi + F_j(\dot q, \ddot q)\,\varphi + a_j f_j(x_j)
        + z_j^\top d_j + \varepsilon_j

    The weights β = (π, φ) are inertial parameters and friction, with the features of `RigidBodyRegressor`. All joints
    share them, and their prior mean is the robot's model. The error of a motor gain is c_j. The sparse Gaussian process
    f_j (`EVGPRegressor`) learns the residual torque from the joint's own signals and load, x_j. Its share in the
    prediction is a_j, from 0 to 1. The offset, friction and gain of one move are d_j. The noise ε_j is larger at low
    speeds, where the sign of Coulomb friction is unknown. The user guide explains each term: :doc:`/guide/torques`.

    Parameters
    ----------
    robot : RigidBodyRegressor, str, path-like, System, pinocchio.Model or None, default=None
        Approximate model of the robot, such as a URDF with inaccurate masses. Pass a `RigidBodyRegressor` to set
        friction and prior scales. If None, each output has its own linear model and a Gaussian process of all columns.
    gain_scale : float, default=0.0
        Prior standard deviation of the relative error of each motor gain. For example, use 0.1 if y are currents times
        gains of a data sheet, and 0 if y are torques. It mostly affects masses and their intervals.
    consistent : bool, default=False
        Whether to move the weights to the most probable physical ones, with masses above 0 and positive definite
        pseudo-inertias. Covariances and noise do not change.
    stiction_velocity : "auto" or None, default="auto"
        If ``"auto"``, find the velocity v_s of the mean friction :math:`F \tanh(\dot q / v_s)` of each joint with its
        uncertainty (``theta_``). If None, use that of `RigidBodyRegressor`.
    learn_scales : bool, default=True
        Whether to learn a factor for the prior standard deviations of each group of weights: inertial parameters, and
        each kind of friction (`RigidBodyRegressor.coef_groups`). A machine that is much heavier than its model needs
        it. Factors of friction are from 1e-4 to 1e4, that of inertial parameters from 1 to 1e4.
    move_scale_prior : array-like of shape (4,), default=(0.015, 0.05, 0.04, 0.007)
        Standard deviations between days, at most 1e6, which are added to the differences between training moves: of the
        offset over Coulomb friction, of viscous and of Coulomb friction over itself, and of the gain. The default is
        what arms show. With zeros, only the training moves count.
    n_inducing : int, default=40
        Number of inducing points of each f_j. With 0 there are no f_j.
    max_rows : int, default=3000
        Maximum number of rows for the fit of each f_j, evenly spread over the log. Weights are fitted to all rows.
    max_iter : int or None, default=None
        Maximum number of iterations for each f_j, as in `EVGPRegressor`.
    n_jobs : int or None, default=None
        Number of joints to fit in parallel threads. None means 1, and -1 means all cores.
    random_state : int, RandomState instance or None, default=None
        Seed of the inducing points.

    Attributes
    ----------
    coef_, coef_std_ : ndarray of shape (n_h,)
        Posterior means and standard deviations of β, in the order of ``coef_names_``.
    coef_cov_ : ndarray of shape (n_h, n_h)
        Posterior covariance of β.
    coef_names_ : ndarray of str of shape (n_h,)
        Names of the weights, such as m(q1), mcx(q1) and viscous(q1).
    coef_prior_mean_, coef_prior_scale_ : ndarray of shape (n_h,)
        Prior means and learned prior standard deviations of β. If ``coef_std_`` is close to the latter, torques do not
        determine the weight.
    theta_, theta_std_ : dict of str to float
        Posterior medians of the velocities v_s, rad/s or m/s, and their standard deviations to first order. A key is
        ``"stiction_velocity(q1)"``. They are empty if ``stiction_velocity`` is None, or without Coulomb friction.
    gains_, gains_std_ : ndarray of shape (n_outputs,)
        Gains 1 + c and their standard deviations. They multiply the torques of rigid bodies.
    noise_variance_ : ndarray of shape (n_outputs,)
        Noise variance σ² of each joint while it moves.
    standing_std_ : ndarray of shape (n_outputs,)
        Standard deviation of the additional noise at rest, due to Coulomb friction.
    residual_std_ : ndarray of shape (n_outputs,)
        Prior standard deviation of each a_j f_j. It is 0 without f_j.
    residual_models_ : list of EVGPRegressor or None
        Models f_j, before their means fade. An entry is None if its share is 0.
    residual_share_ : ndarray of shape (n_outputs,)
        Shares a_j.
    correlation_time_ : ndarray of shape (n_outputs,)
        Number of rows with as much information on the weights as one independent row. All joints of a robot have the
        same.
    inflation_ : float
        Factor by which groups differ more than ``correlation_time_`` explains, at least 1. The information of all rows
        is divided by it.
    stiction_velocity_ : ndarray of shape (n_outputs,)
        Speed below which the sign of friction is unknown and counts as noise, rad/s or m/s.
    move_scale_ : ndarray of shape (n_outputs, 4)
        Standard deviations between moves of the offset, viscous friction, Coulomb friction and relative gain error.
        With few moves, they are larger than the observed ones, also because of ``move_scale_prior``.
    move_ : ndarray of shape (n_outputs, 4)
        These four effects in the log of the last `update`, or 0 before it.
    n_iter_ : int
        Largest number of iterations over all f_j.
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
    `fit` first finds the weights, noise, gains and velocities v_s by Bayesian regression. Then it holds out each group
    in turn, or blocks of rows if there are fewer than three groups. Held-out rows determine the shares a_j, the noise
    and the variances of d_j. Far from the training rows, the mean of f_j fades to 0. The user guide has the details.

    Memory is a few times 8 bytes times n_samples * n_outputs * n_h.

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
    >>> t = np.arange(0.0, 10.0, 0.01)
    >>> q = np.sin(t) + 0.5 * np.sin(2.7 * t)
    >>> dq = np.gradient(q, t)
    >>> X = np.column_stack([q, dq, np.gradient(dq, t)])
    >>> torque = X[:, 2] / 4 + 9.81 / 2 * np.sin(q) + 0.1 * dq + 0.3 * np.tanh(dq / 0.01)
    >>> y = torque + 0.05 * np.random.default_rng(0).standard_normal(len(t))
    >>> robot = perturb_robot("pendulum", random_state=0)
    >>> model = InverseDynamics(robot, n_inducing=10, random_state=0).fit(X, y)
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
        "move_scale_prior": ["array-like"],
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
        move_scale_prior: Sequence[float] = (0.015, 0.05, 0.04, 0.007),
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
        self.move_scale_prior = move_scale_prior
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
            Torques in N m (N), or with ``gain_scale`` currents times gains of a data sheet. They must be at most 1e40.
            The largest of a column must be 0 or above 1e-105.
        groups : array-like of shape (n_samples,), default=None
            Label of the move (trajectory) of each row. Credible intervals for new moves need at least three moves, each
            with less than four fifths of the rows. Otherwise, `fit` holds out blocks of rows.
        pieces : array-like of shape (n_samples,), default=None
            Label of the piece of each row, such as ``load_log(...).pieces``. A piece is a part of the log without gaps.
            If None, each group is a piece.

        Returns
        -------
        self : InverseDynamics
            The estimator itself, fitted.

        Raises
        ------
        ImportError
            If Pinocchio is needed and not installed.
        ValueError, TypeError
            If an argument is out of its range, the data are not finite, or shapes do not fit. Also if X or y is a data
            frame with the robot's joints in another order.

        Warns
        -----
        ConvergenceWarning
            If weights are far from the robot's model, for example because y has other units. If columns seem to be in
            another order, angles in degrees, or positions beyond the limits of the model. If a joint never moves, or
            its torque is far below that of the model. If rows have too little information on the weights.
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
        self._move_scale_prior = as_floats(self.move_scale_prior, "move_scale_prior")
        is_valid = (self._move_scale_prior >= 0.0) & (self._move_scale_prior <= _LARGEST_MOVE_SCALE)
        if is_valid.shape != (len(EFFECTS),) or not is_valid.all():
            raise ValueError(
                f"move_scale_prior must be {len(EFFECTS)} numbers from 0 to {_LARGEST_MOVE_SCALE:g}; got "
                f"{self.move_scale_prior!r}."
            )
        self._one_dimensional = targets.ndim == 1
        targets = targets.reshape(len(targets), -1)
        check_magnitude(rows_x, "X")
        check_magnitude(targets, "y", _LARGEST_TORQUE)
        check_not_vanishing(np.abs(targets).max(axis=0), "y", _SMALLEST_TORQUE)
        self.feature_map_ = self._map().fit(X)  # checks the order of a data frame's columns
        self._check_columns_of_y(y)
        with ignored(category=RobotModelWarning):  # the first fit has warned
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
        named = "".join(f"{cause[0].upper()}{cause[1:]}. " for cause in causes)
        little = self._furthest(y.shape[1])
        if self._unexplained:
            little += f" Less than half of the variance of the torques of {self._unexplained} is explained."
        return (
            f"The robot's model does not fit the torques. {named}{'Otherwise, its' if causes else 'Its'} masses may be "
            "placeholders, or y may have other units. "
            f"Give {'' if self.learn_scales else 'RigidBodyRegressor wider scales, or '}y in N m. The weights are "
            f"{self._weights.surprise:.1f} prior standard deviations from the model.{little}"
        )

    def _furthest(self, n_outputs: int) -> str:
        """Return a sentence with the weights that are furthest from the robot's model, in its standard deviations."""
        names, weights = self._names(n_outputs), self._weights
        n = len(names)
        scale = np.sqrt(np.diag(weights.prior.covariance))[:n] / weights.factors[:n]
        change = np.abs(weights.mean - weights.prior.mean)[:n] / np.where(scale > 0.0, scale, np.inf)
        largest = [str(names[at]) for at in np.argsort(-change)[:_MOST_NAMED] if change[at] > 1.0]
        return f" The largest changes are those of {', '.join(largest)}." if largest else ""

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
                self._usual(j),
                **options,
            )
            for j, velocity in enumerate(weights.prior.velocity)
        )
        return Parallel(n_jobs=self.n_jobs, prefer="threads")(fits)

    def _usual(self, joint: int) -> np.ndarray:
        """Return the prior standard deviations of the effects of moves on a joint, (4,)."""
        names = [str(name) for name in self._names(len(self._weights.noise))]

        def friction(kind: str) -> float:
            name = f"{kind}({self._outputs[joint]})"
            return abs(float(self._weights.mean[names.index(name)])) if name in names else 0.0

        units = [friction("coulomb"), friction("viscous"), friction("coulomb"), 1.0]
        return self._move_scale_prior * units

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
            Whether to include the noise of measured torques in the standard deviation.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_joints)
            Mean of the torques, in the units of y.
        std : ndarray of the same shape
            Standard deviation of the torques, returned only if ``return_std=True``.
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
        """Return the mean of torques, and the variance due to f_j and effects of moves, (n, o) each."""
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
        """Adapt the predictions to a new log, from its first few seconds.

        Friction changes with temperature, and sensors drift. So offset, friction and gain of a joint differ between
        moves. `fit` finds their variances (``move_scale_``), and `update` finds their values in the new log. Weights
        and f_j do not change.

        `fit` tests updates with the first third of each held-out move. `update` changes a joint only if these updates
        reduced the errors in the rest of the moves.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈] in the order of time.
        y : array-like of shape (n_samples, n_joints) or, of one joint, (n_samples,)
            Torques, in the units of `fit`.
        pieces : array-like of shape (n_samples,), default=None
            Label of the piece of each row, as in `fit`.

        Returns
        -------
        self : InverseDynamics
            The estimator itself. It now predicts the move of X. The next call replaces the effects of this one.

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
        """Test whether a log fits the model.

        A log does not fit if the robot has another load, a fault or contact. The test compares the errors of the log
        with those of held-out moves in `fit`: their mean square, and the offset, friction and gain that explain them.
        It ignores `update`.

        Parameters
        ----------
        X, y, pieces : array-like
            The log, as in `update`.
        dt : float, default=0.01
            Time between rows, s.
        false_alarms_per_minute : float, default=0.01
            Expected number of false alarms per minute, for logs without a fault.

        Returns
        -------
        check : Bunch
            - ``fits`` : bool, whether the log fits;
            - ``p_value`` : float, probability of such large errors in a log without a fault;
            - ``p_values`` : ndarray of shape (n_joints,), the probability for each joint alone;
            - ``joints`` : list of str, names of the joints that do not fit.

        Raises
        ------
        ValueError, TypeError
            If shapes do not fit, data are not finite, an argument is out of its range, or `fit` had fewer than three
            ``groups``.

        Notes
        -----
        If `fit` had few moves, the test finds only large faults.

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
        """Return the rows of a new log, its errors and their std (n, o) as a new move, and z of each joint."""
        check_is_fitted(self)
        if self._n_moves < FEWEST_MOVES:
            raise ValueError(
                f"{method} compares moves. Call fit with at least {FEWEST_MOVES} groups; got {self._n_moves}. With "
                "load_log, one file is one group."
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

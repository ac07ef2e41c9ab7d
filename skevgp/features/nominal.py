"""Accelerations and torques of an approximate rigid-body model as explicit features."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np

from ..robots import Layout, RigidBody
from ..robots.loading import Robot, known_robot
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval, StrOptions
from .robot_map import STEP, RobotMap, VelocityPrior

_NAMES = {
    "acceleration": "acc({})",
    "gravity": "gravity torque({})",
    "bias": "bias torque({})",
    "input": "acc by u({})",
}


class NominalDynamics(RobotMap):
    r"""Features from an approximate model of the robot, such as a URDF with inaccurate masses and no friction.

    The model's equation of motion is

    .. math:: M(q) \ddot q + C(q, \dot q) \dot q + D \dot q + g(q) = B u

    with its viscous damping D and the inputs on the driven joints. Each term has one column per joint. Join them to
    `InertiaForce`, as in the example: with an exact model, the prior mean then predicts Euler's rule
    :math:`\dot q' = \dot q + \Delta t\,\ddot q`.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        The approximate model, as in `skevgp.datasets.load_robot`. If None, X passes through and the weights get the
        regressor's wide default prior.
    terms : sequence of str, default=("acceleration",)
        Groups of columns, in the given order:

        - ``"acceleration"``: :math:`\ddot q`, rad/s² or m/s²;
        - ``"gravity"``: :math:`g(q)`, N m or N;
        - ``"bias"``: :math:`C \dot q + g`, N m or N;
        - ``"input"``: :math:`M^{-1} B u`, the acceleration by the input.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row, and weights are
        rates (see Notes).
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all of them, [q, q̇].
    model_error : float, default=0.3
        Relative error of the model's accelerations. The weight of a joint's acceleration for its velocity is Δt times 1
        ± ``model_error``.
    unknown_ratio : float, default=1.0
        Prior standard deviation of what the torques ``"gravity"`` and ``"bias"`` contribute to velocities, as a
        multiple of the change that the prior mean of all features leaves.
    other_ratio : float, default=0.03
        The same for all other weights, whose mean is 0. With 0 they stay 0.

    Attributes
    ----------
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    InertiaForce : Features of the state and the input, the other half of Euler's rule.
    skevgp.datasets.perturb_robot : Make an inaccurate model for experiments.

    Notes
    -----
    Masses with an error of 20 % change accelerations by about as much; the default of ``model_error`` is somewhat
    wider. The prior standard deviations for a position are Δt times those for its velocity.

    If ``terms`` has ``"acceleration"``, the weights of ``"input"`` are corrections with mean 0. Otherwise their mean is
    Δt.

    With ``dt="column"`` the features are multiplied by the Δt of their row, and the weight of a joint's acceleration
    has mean 1 and standard deviation ``model_error``.

    Effort limits are not applied, and dry friction is left out. Do not scale the columns of X before this map. Scale in
    the ``kernel_map`` of the regressor, which only the kernel uses.

    Examples
    --------
    >>> from sklearn.pipeline import make_union
    >>> from skevgp.features import InertiaForce, NominalDynamics
    >>> nominal = NominalDynamics("pendulum", terms=["acceleration", "gravity"])
    >>> nominal.fit_transform([[0.1, 0.0, 1.0]]).round(4)
    array([[2.0413, 0.4897]])
    >>> nominal.get_feature_names_out().tolist()
    ['acc(q)', 'gravity torque(q)']
    >>> nominal.coef_prior(n_outputs=2)[0]
    array([[0.  , 0.  ],
           [0.03, 0.  ]])
    >>> make_union(InertiaForce("pendulum"), nominal).fit_transform([[0.1, 0.0, 1.0]]).shape
    (1, 5)

    With the time step of each row as its last column:

    >>> logged = NominalDynamics("pendulum", dt="column")
    >>> logged.fit_transform([[0.1, 0.0, 1.0, 0.01], [0.1, 0.0, 1.0, 0.02]]).round(4)
    array([[0.0204],
           [0.0408]])
    >>> logged.get_feature_names_out().tolist()
    ['dt * acc(q)']
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        terms: Sequence[str] = ("acceleration",),
        dt: float | Literal["column"] = STEP,
        outputs: Sequence[int | str] | None = None,
        model_error: float = 0.3,
        unknown_ratio: float = 1.0,
        other_ratio: float = 0.03,
    ):
        self.robot = robot
        self.terms = terms
        self.dt = dt
        self.outputs = outputs
        self.model_error = model_error
        self.unknown_ratio = unknown_ratio
        self.other_ratio = other_ratio

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotMap._parameter_constraints,
        "terms": ["array-like"],
        "dt": [Interval(Real, 0, None, closed="neither"), StrOptions({"column"})],
        "model_error": [Interval(Real, 0, None, closed="left")],
        "unknown_ratio": [Interval(Real, 0, None, closed="left")],
        "other_ratio": [Interval(Real, 0, None, closed="left")],
    }

    def _prepare(self, robot: Robot | None) -> None:
        self._check_terms()
        self._terms = tuple(self.terms)
        if robot is None:
            return
        self._body = RigidBody(known_robot(robot))
        # A massless tip makes the mass matrix singular in nearly every configuration. This row raises the error early.
        self._features(np.random.RandomState(0).uniform(-1.0, 1.0, (1, self._layout.n_columns)))

    def _check_terms(self) -> None:
        terms = [term for term in self.terms if isinstance(term, str) and term in _NAMES]
        if not terms or len(terms) < len(self.terms) or len(set(terms)) < len(terms):
            raise ValueError(f"terms={self.terms!r} must be one or more of {list(_NAMES)}, each once.")

    def _features(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return X.copy()
        n = self._layout.n_joints
        q, v, u = X[:, :n], X[:, n : 2 * n], X[:, 2 * n :]
        body = self._body
        columns = {
            "acceleration": lambda: body.accelerations_under(q, v, u),
            "gravity": lambda: body.gravity(q),
            "bias": lambda: body.forces(q, v, np.zeros_like(v)),
            "input": lambda: body.accelerations_by_force(q, body.joint_forces(u)),
        }
        features = np.hstack([columns[term]() for term in self._terms])
        self._check_finite(features, q)
        return features

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
        n = self._layout.n_joints
        q, v, u = X[:, :n], X[:, n : 2 * n], X[:, 2 * n :]
        body = self._body
        blocks = {
            "acceleration": lambda: body.accelerations_under_jacobian(q, v, u),
            "gravity": lambda: body.gravity_jacobian(q),
            "bias": lambda: body.forces_jacobian(q, v, np.zeros_like(v)),
            "input": lambda: body.accelerations_by_force_jacobian(q, u),
        }
        jacobian = np.concatenate([blocks[term]() for term in self._terms], axis=1)
        self._check_finite(jacobian, q)
        return jacobian

    def _check_finite(self, values: np.ndarray, q: np.ndarray) -> None:
        if not np.isfinite(values).all():
            bad = ~np.isfinite(values).reshape(len(q), -1).all(axis=1)
            raise ValueError(self._why_not_finite(q[bad][0]))

    def _why_not_finite(self, q: np.ndarray) -> str:
        """Return the text of the error for one configuration."""
        names, inertias = self._layout.position_names, np.diag(self._body.mass_matrix(q))
        light = [name for name, inertia in zip(names, inertias, strict=True) if inertia == 0.0]
        return f"The dynamics of the robot {self._layout.name!r} are not finite: " + (
            f"its joints {light} move no mass."
            if light
            else f"its mass matrix is singular at q = {q.tolist()}, or q̇ or u is too large there."
        )

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return columns.tolist()
        return [_NAMES[term].format(name) for term in self._terms for name in columns[: self._layout.n_joints]]

    def _is_known(self, term: str) -> bool:
        """Whether a joint's own column of a term predicts its acceleration."""
        return term == "acceleration" or (term == "input" and "acceleration" not in self.terms)

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        self._check_terms()
        n = layout.n_joints
        return np.vstack(
            [
                np.zeros((n, n * len(self.terms))),
                np.hstack([dt * self._is_known(term) * np.eye(n) for term in self.terms]),
            ]
        )

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        # Blocks (n_joints, n_joints) of the terms, next to each other.
        self._check_terms()
        n = layout.n_joints
        prior = VelocityPrior.of(n, 0, 0.0, "")
        for term in self.terms:
            block = VelocityPrior.of(n, n, self.other_ratio, "other accelerations")
            if term in ("gravity", "bias"):
                block = VelocityPrior.of(n, n, self.unknown_ratio, f"{term} torques")
            elif self._is_known(term):
                block.set_rate(np.eye(n, dtype=bool), self.model_error, "model")
            prior = prior.beside(block)
        return prior
